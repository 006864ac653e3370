"""What images show, carried onto surfaces: the colours of a cloud, mosaics, indices. A point takes only what could see it."""
