"""A flight for ROS 2 and Foxglove: decoded topics in one MCAP file. docs/ros.md says what they hold.

messages   the ROS 2 messages that are written, as bytes
scale      all clocks of a log on one scale: UTC where they can be tied, else log time
clouds     shots, gathered turn by turn
streams    each topic as messages in the order of their time
bag        the file

Axes are those of ROS (REP 103): bodies have x forward, y left, z up, where swath has right, forward, up; the map has east, north, up.
"""
