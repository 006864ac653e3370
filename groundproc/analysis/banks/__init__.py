"""Banks: upper and lower edge, the line of the water, and between two epochs their retreat and the volume lost."""
