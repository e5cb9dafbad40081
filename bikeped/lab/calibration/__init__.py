"""From checkerboard pictures to a lens that one can trust (paper, section on calibration)."""
