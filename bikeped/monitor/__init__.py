"""May what was seen be trusted? Health of the picture, drift of the camera."""
