"""Calibration in flight: the source's dynamic calibration (method `dynamic`), and the compass model learnt from it.

options       every number of it
revolutions   the flight cut into turns of the scanner, deskewed, ready to be placed again under trims
ground_model  rasters of heights and their differences
plan          what stands upright, seen from above
search        one revolution after another, one variable after another: the trims
course        course over ground, the witness of yaw trims
compass       trim against heading over several runs
lasers        corrections of the single lasers: the file
dynamic       the method: first pass, trims, second pass
"""
