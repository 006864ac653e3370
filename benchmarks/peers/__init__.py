"""Other people's programs that make a trajectory of lidar scans, behind one shape: what they are given, and what they give back.

scans       packets to scans with a time for each point
motion      how the lidar moves while it scans: by constant velocity, or by gyros
odometries  KISS-ICP and small_gicp, as named peers
"""
