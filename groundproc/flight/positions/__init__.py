"""Position solutions from outside: RTKLIB .pos, SBET, NMEA, poses with covariance; and RTKLIB run on raw observations."""
