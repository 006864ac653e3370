"""Aboard: UDP and MAVLink in, flight log out. The daemon is `swathd`.

Map
---
config          what the operator may set
fovmask         which packets and blocks lie outside the field of view (pure)
timesync        log time from the host's clocks; kernel receive times across a step of the wall clock (pure)
status          the status of everything, as the status file holds it (pure)
health          the verdict on it (pure)
healthreport    both in words (pure)
clocksync       how the clocks of autopilot and lidar stand to log time (pure)
datagrams       many datagrams of a socket in one system call, with the kernel's receive times and drop counts
packetfilter    a socket's filter in the kernel: sender, length, interface
lidar           the HDL-32E's two ports -> batches
lidarsender     who the lidar is, and the filters that let in nobody else
lidarcounts     what became of all that arrived at its ports
positionpackets its position packets into the log
batch           slots that collect datagrams until a message is due
lidarstate      the state of the lidar, by name
sensorview      the lidar's settings, inferred from its packets (pure)
sources         the serial device or UDP port of a MAVLink link
autopilot       MAVLink links -> raw chunks
linkcounts      what came over a link, and what its autopilot says of itself
requester       what is sent so that an autopilot speaks: heartbeats, requests for streams
autopilotclock  an autopilot's boot time and UTC: TIMESYNC, or its stamps
voice           our frames on a link, in the autopilot's version of MAVLink
announce        what the ground station is told (pure)
readings        the receivers' counters -> the status
preflight       the checks before a flight
backlog         what the disk has not taken yet, bounded
recorder        backlog -> segments of the flight log, synced to the disk twice a second
spacewatch      whether there is room on the disk for it
segment         one file of the flight log, until it is read-only and in the manifest
logfolder       names, manifest, space
leftovers       logs that a power cut left open, mended while recording goes on
relay           live downlink: sends to the ground what is received, and never harms the recording
lidar_settings  the lidar's web server: settings compared, set, verified
parameters      files of autopilot parameters, and the comparison (pure)
parameter_link  parameters over MAVLink: read, set, confirmed
commands        commands of `swathd` other than recording
worker          a thread whose progress is watched
notify          messages to systemd
journal         log lines, with fields where there is a journal
gate            what a key of `swath pull` may do
install         `swathd install` and `uninstall`
landing         when a flight has ended (pure)
daemon          start, run, stop
cli             the command line

How it runs: one thread polls the lidar's sockets, one serves each MAVLink link, and one writes. The main thread
runs the clocks, the status and the watchdog. Receivers never wait for the writer: what its backlog cannot take is
dropped and counted.
"""
