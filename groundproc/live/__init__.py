"""The flight as it happens: packets and telemetry in, pose and a thinned cloud out, a tenth of a second late.

inputs --Inbox--> Session --> Estimator (slices, motion, odometry) --> VoxelCloud, live trajectory, status, page in a browser
"""
