"""A cloud in a web browser: what it is told of the attributes, how points travel, and a server for clouds of any size.

The page is `web/`: plain JavaScript and WebGL 2, with nothing from elsewhere. Both the flight report and `swath view` show clouds with it.
"""
