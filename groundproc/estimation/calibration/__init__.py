"""What several flights tell together: the mount, the lasers, the compass curve."""
