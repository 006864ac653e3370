"""Inertial navigation of a whole flight: two IMUs, what the autopilot states, and poses from outside, in one estimate with covariance.

imu           the autopilot's gyros and accelerometers and the lidar's made into one IMU on one grid of time
readings      what one boot of the autopilot and the lidar beside it measured
reference     rates and forces of each step, and the path that the estimate is linearised about
motion        what moves the states about it
transition    the step of the states from node to node
kalman        Kalman filter and backward smoother: one Gauss-Newton step over the whole flight
smoother      the iteration: linearise, smooth, learn the noise, again
solution      what it hands over

The states and the noise assumed of each sensor stand in `observations.states`; what is measured, as rows, in the files of `observations`.
"""
