"""Where the aircraft was and how it was turned: the type that all methods make, and its files.

trajectory  the type: knots with sigma, and poses at any time between them
table       trajectory.csv, written and read
"""
