"""May what was seen be trusted? The picture, the camera's place, the detector."""
