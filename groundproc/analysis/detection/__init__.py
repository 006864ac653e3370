"""Hard targets under leaves.

layers      counts of pulses by cell and height above the ground
targets     where the counts of a layer are those of something solid with a flat top, rather than of what grows there
"""
