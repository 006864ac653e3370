"""Where the aircraft was and how it was turned: the type that all methods make, and the methods.

trajectory  the type: knots with sigma, and poses at any time between them
method      what every method is given, and what it gives back
methods     the methods by their names on the command line
ins         the autopilot's own solution, interpolated (method `ins`)
filtered    inertial navigation, smoothed over the whole flight (method `filtered`)
table       trajectory.csv, written and read
"""
