"""Strip adjustment of clouds of any origin: a trajectory and georeferenced points in, both with the errors of the trajectory taken out.

After Glira, Pfeifer, Mandlburger, "Rigorous strip adjustment of UAV-based laserscanning data including time-dependent correction of
trajectory errors" (PERS 82/12, 2016): corrections of the trajectory are cubic splines in time, boresight and lever arm are constants,
and what overlapping strips see of one surface has to agree. Unlike there, planes are unknowns that are solved for within.

All is done in the map coordinates of the cloud (easting, northing, height; "map" in names). Only corrections are computed, so that a
point that needs none keeps its coordinates to the last digit; the scale of a projection, 0.04 % at most, touches corrections alone.
"""
