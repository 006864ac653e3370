"""Thin things along a corridor: conductors, poles, masts, stays, fences.

thin         points that lie on a line with nothing beside it
chains       such points joined along their lines
catenary     the curve of a hanging wire through a chain
spans        conductors from attachment to attachment
poles        upright things
columns      the search for them among columns of points, compiled
strips       fences and stays
clearance    how far points are from the nearest wire
"""
