"""Where the aircraft was and how it was turned: the type that all methods make, and the methods.

trajectory  the type: knots with sigma, and poses at any time between them
ins         the autopilot's own solution, interpolated (method `ins`)
table       trajectory.csv, written and read
"""
