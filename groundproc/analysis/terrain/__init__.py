"""Bare ground from clouds, on rasters of the lowest points.

settings     what the filter goes by, presets for kinds of terrain, and what follows from the cloud itself
filter       which of the lowest points are ground: openings of growing size above smoothed ground, thresholds from its relief
floor        the ground of a whole cloud, above which heights of its points are measured
holdout      how well heights of ground that were left out are predicted
building     roofs: planes that stand above the ground with steps around them, and their outlines
surfaces     rasters of whole areas, block by block, on the disk
"""
