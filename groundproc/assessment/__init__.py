"""How good a cloud is against what is known from elsewhere: surveyed points, another cloud, two sets of coordinates.

A difference is always "this less the reference", in the CRS of the cloud.
"""
