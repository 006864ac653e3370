"""Images of a flight: which image when, tie points, bundle block adjustment; what colours, mosaics and indices rest on.

Conventions, once:

- *Pixel* (0, 0) is the centre of the upper left one; x goes right, y down.
- The *camera* frame is x right, y down, z forward, as Kalibr and OpenCV have it: p_cam = T_cam_imu p_ins. The ins frame is right, forward,
  up, as everywhere here.
- Angles of an image are photogrammetric: world-from-camera = Rx(omega) Ry(phi) Rz(kappa) with the camera's x right, y *up*, z *backwards*,
  against grid east, grid north and up.
- The time of an image is that of its middle row, t_utc = t_exif + timeshift_cam_imu; row r is exposed (r - middle) line_delay_s later.
- The block is adjusted in a local frame: the plane tangent to the ellipsoid where a coordinate system is known, else the
  coordinates as they are. Never in grid coordinates.
"""
