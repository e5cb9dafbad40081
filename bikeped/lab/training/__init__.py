"""Augments data, and trains, exports and evaluates detectors."""
