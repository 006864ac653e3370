"""Inertial navigation of a whole flight: two IMUs, what the autopilot states, and poses from outside, in one estimate with covariance.

model         the states and the noise assumed of each sensor
imu           the autopilot's gyros and accelerometers and the lidar's made into one IMU on one grid of time
measurements  what is measured, as rows of a linear system
transition    the step of the states from node to node
kalman        Kalman filter and backward smoother: one Gauss-Newton step over the whole flight
solution      the iteration: linearise, smooth, learn the noise, again
"""
