"""Where the aircraft was and how it was turned: the type that all methods make, and its files.

trajectory  the type: knots with sigma, and poses at any time between them
covariance  what the errors of one pose have to do with each other
table       trajectory.csv, written and read
estimate    all that was found of a flight, as a folder: trajectory, mount, lasers, clocks, report; written and read
exports     the same in the formats of other programs: one file each
"""
