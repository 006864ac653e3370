"""Arrays in, arrays out: no file, clock, log or flight, and no other room.

rotations   quaternions, rotation vectors and matrices inside kernels
splines     uniform cubic B-splines
robust      the sigma that a median tells, and weights of losses that bend
voxelhash   keys of voxels, and points sorted by them
planes      planes through the second moments of points
layout      arrays as kernels take them, of one type whatever the caller has
memory      arrays whose memory is used again
planerows   distances from such planes as rows of a least-squares problem, the planes solved for within
planeproducts  the normal matrix of such rows times vectors
parts       a kernel's work shared out between cores
filters     low-pass, spectrum and peaks of evenly spaced series

Kernels take few arguments: what belongs together is a named tuple of arrays, whose fields have shape, dtype and unit in its docstring. A
dataclass that kernels work on has a property `arrays` that makes one. They unpack it once, above their loops.
"""
