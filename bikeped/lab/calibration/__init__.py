"""Lens calibration from checkerboard images (paper, section on calibration)."""
