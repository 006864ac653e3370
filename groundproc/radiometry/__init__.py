"""From what a lidar says of an echo's strength to the diffuse reflectance of the surface, with its sigma.

The lidar equation of an extended Lambertian target (Wagner et al. 2006; Lehner and Briese 2010; Briese et al. 2012):

    reflectance = c_cal I R^2 / (eta cos a)

I is the linear strength of the echo, corrected for the gain of its laser; R the range, eta the share of light that the air lets through
on both ways, a the angle of incidence. A sensor that compensates for the range itself has no R^2. c_cal holds all that is constant in a
flight: it is found from surfaces whose reflectance is known.
"""
