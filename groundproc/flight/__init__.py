"""From files to one flight on one time scale.

load, flight      logs into arrays; what of a flight fits in memory
importers         logs made of captures and telemetry of other programs
autopilot         MAVLink as tables, boot by boot
positions         GNSS solutions and poses of other programs
sync              the clocks of lidar and autopilot, from their gyros
vehicle           which of several autopilots on a link carried the lidar
timebase          clocks against receive times and UTC
timeline          all clocks on one scale, leg by leg
mounting, control what a user states: the mount, surveyed points
summary           what `swath info` says of a log
"""
