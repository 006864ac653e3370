"""The adjustment: lidar, inertial sensors and GNSS in one least-squares problem over the flight (method `adjusted`).

motion      rates and specific force of all inertial sensors on one grid
scans       packets to slices of 0.1 s, and each slice to clusters: the returns of one voxel at one instant
voxels      a map of planes in a hash of voxels
odometry    slice after slice against the map of those before: an iterated error-state filter; the causal mode
track       the forward pass: start, silent slices, fixes, loss of way
beginning   the first seconds again, backwards
planes      what the lidar says, with the planes solved for within; lasers: each laser's own offsets with them
factors     what everything else says; anchors, outside: what ties the path to the earth
control     surveyed points and planes; surfaces: the map where they lie; datum: the map laid on them as a whole
coarse      slow bends, the preconditioner's second level
solve       one Gauss-Newton step by conjugate gradients
noise       where errors come from, for the sigmas
batch       all of them, and the posterior
windows     of a long flight; patches: the ground that several saw; joining: one adjustment over them all
adjusted    the method
mount_calibration  the mount of several flights
spline      uniform cubic B-splines
rotations   rotations inside kernels
"""
