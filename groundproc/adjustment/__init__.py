"""The adjustment: lidar, inertial sensors and GNSS in one least-squares problem over the flight (method `adjusted`).

motion      rates and specific force of all inertial sensors on one grid
scans       packets to slices of 0.1 s, and each slice to clusters: the returns of one voxel at one instant
voxels      a map of planes in a hash of voxels
odometry    slice after slice against the map of those before: an iterated error-state filter; the causal mode
spline      uniform cubic B-splines
rotations   rotations inside kernels
"""
