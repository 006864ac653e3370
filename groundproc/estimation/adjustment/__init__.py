"""The adjustment: lidar, inertial sensors and GNSS in one least-squares problem over the flight (method `adjusted`).

It begins from the path and the clusters of `odometry`.

planes      what the lidar says, with the planes solved for within; lasers: each laser's own offsets with them
factors     what everything else says; anchors, outside: what ties the path to the earth
control     surveyed points and planes; surfaces: the map where they lie
datum       the map laid on them as a whole; spots: the places and how a map is placed; search: all that is within three sigma
coarse      slow bends, the preconditioner's second level
solve       one Gauss-Newton step by conjugate gradients
noise       where errors come from, for the sigmas
batch       all of them, and the posterior
windows     of a long flight; patches: the ground that several saw; joining: one adjustment over them all
adjusted    the method
"""
