"""Methods that estimate a trajectory, by name, and what they are made of.

method      what a method is, and what it is given
methods     the methods by their names
legs        a trajectory made leg by leg
direct      the autopilot's own solution, interpolated (method `ins`); ins: its parts
filtered    inertial navigation, smoothed over the whole flight (method `filtered`); inertial: its parts
dynamic     the source's dynamic calibration (method `dynamic`)
adjustment  lidar, inertial sensors and GNSS in one least-squares problem (method `adjusted`)
calibration mount and compass from several flights
surveyed    positions and control points that the survey names, in the flight's frame

A method is one file and one line. The file holds a function from what is given (`method.Given`) to an `Estimate`, and METHOD, which
states the function and the options of the survey that it looks at beside those of all methods:

    METHOD: Final = Method(still_better_estimate, options=("positions",))

The line is in `survey/methods.py`: the name on the command line and the module. Survey, command line, checks, steps and the report take
it from there.
"""
