"""What several flights determine together: the mount, the lasers, the compass curve."""
