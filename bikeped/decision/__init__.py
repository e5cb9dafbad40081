"""The three-stage decision. Pure: positions and times in, state and reasons out."""
