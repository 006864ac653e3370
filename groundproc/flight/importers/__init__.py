"""Recordings of other programs (Wireshark, tcpdump, Mission Planner, MAVProxy, ArduPilot) as streams of events with times."""
