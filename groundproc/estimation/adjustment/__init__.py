"""The adjustment: lidar, inertial sensors and GNSS in one least-squares problem over the flight (method `adjusted`).

It begins from the path and the clusters of `odometry`; what each source of measurements says is in `observations`.

coarse      slow bends, the preconditioner's second level
solve       one Gauss-Newton step by conjugate gradients
noise       where errors come from, for the sigmas
posterior   what a solution knows of itself; poses: covariance of the path's poses
batch       all observations of a stretch of the flight, adjusted
windows     of a long flight; patches: the ground that several saw; joining: one adjustment over them all
run         a run of the lidar's clock once it is adjusted; causal: by the odometry alone; sensorpath: from the sensor to the ins frame
figures     arrays that pictures are drawn from
pace        progress
adjusted    the method
"""
