"""How far a trajectory and its cloud are from the truth, for flights whose truth is known; an outside trajectory is judged the same way.

truth      what really was: poses, mount and true echoes of a simulated flight, on the lidar's clock
alignment  the one rigid motion that is free when trajectories are compared
poses      errors of poses: position, rotation, heading and how soon it settles, relative motion, stated sigmas
patches    thickness of facades
ground     differences of the ground between revolutions and between strips
cloud      errors of points against their true echoes, second by second
judge      all of it for one trajectory
"""
