"""Pictures for people: the camera's view with what was found, and a bird's-eye radar.

Pure functions over the stage types; only `VideoWriter` writes to disk.
"""
