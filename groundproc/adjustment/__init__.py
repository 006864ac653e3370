"""The adjustment: lidar, inertial sensors and GNSS in one least-squares problem over the flight (method `adjusted`).

motion      rates and specific force of all inertial sensors on one grid
scans       packets to slices of 0.1 s, and each slice to clusters: the returns of one voxel at one instant
voxels      a map of planes in a hash of voxels
odometry    slice after slice against the map of those before: an iterated error-state filter; the causal mode
track       the forward pass: start, silent slices, fixes, loss of way
beginning   the first seconds again, backwards
planes      what the lidar says, with the planes solved for within
factors     what everything else says; anchors: what ties the path to the earth
solve       one Gauss-Newton step by conjugate gradients
batch       all of them, and the posterior
windows     of a long flight
adjusted    the method
mount_calibration  the mount of several flights
spline      uniform cubic B-splines
rotations   rotations inside kernels
"""
