"""Arrays in, arrays out: rotations, splines, robust statistics, hashes of voxels, planes. No file, clock, log or flight."""
