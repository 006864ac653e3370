"""Settings of the aircraft as data files: mount, autopilot parameters, lidar; each value with its reason."""
