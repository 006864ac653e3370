"""Lidar-inertial odometry: slice after slice against the map of those before.

grid        the grid that motion is kept on
motion      rates and specific force of all inertial sensors on that grid
slices      shots to slices of 0.1 s, and each slice to clusters: the returns of one voxel at one instant
clusters    clusters of many slices, as columns
voxels      a map of planes in a hash of voxels
spline      the path of the sensor, and the spline that corrects it
stated      positions and attitudes of the autopilot, as they become known
state       where the sensor is, and its propagation by the inertial data
matching    distances of clusters from the map, and the correction by them
within      rotations within a slice, between two corrections
rotor       the line of the spin, in time
odometry    state and matching as an iterated error-state filter; the causal mode
start       the rough pose that it begins from
bearing     the heading of its map against the Earth's
history     where the sensor was in the last seconds
surfaces    what a map holds, by kinds
seeking     where one map may lie on another, roughly
laying      one map fitted closely to another, from a start on
relocation  one map laid on another metres away, or not at all
rejoining   a path that was lost and comes back
tracker     the forward pass over a recording or a flight that goes on: start, silent slices, fixes, loss of the path
track       what the forward pass found
beginning   the first seconds again, backwards
"""
