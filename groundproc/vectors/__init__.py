"""Lines, places and areas: read from and written to GeoPackage, GeoJSON and DXF."""
