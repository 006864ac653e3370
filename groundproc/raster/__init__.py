"""Rasters: cells filled by one pass over points, what is derived of their heights, and GeoTIFF.

Cells are counted from the origin of the CRS: column i spans i to i + 1 cells east of it, row j spans j to j + 1 cells north of it. So all
rasters of one cell size share their edges, whatever they were made of. A point on an edge belongs to the cell east or south of it, as
GDAL has it. Arrays have their first row in the north, as in the file.
"""
