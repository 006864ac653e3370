"""Methods that estimate a trajectory, by name, and what they are made of.

method      what every method is given, and what it gives back
methods     the methods by their names
ins         the autopilot's own solution, interpolated (method `ins`)
filtered    inertial navigation, smoothed over the whole flight (method `filtered`); inertial: its parts
dynamic     the source's dynamic calibration (method `dynamic`)
adjustment  lidar, inertial sensors and GNSS in one least-squares problem (method `adjusted`)
calibration mount and compass from several flights
surveyed    positions and control points that the survey names, in the flight's frame
"""
