"""The lamp: its devices, and the process of its own that drives one. Standard library only."""
