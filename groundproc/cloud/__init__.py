"""Shots and poses to points in the world, and clouds as files."""

from groundproc.machine.system import without

with without("requests"):  # laspy's way to clouds on servers, which nothing here takes: 0.14 CPU-seconds
    import laspy as laspy
