"""Scenarios through simulated perception, the deployed tracker and rules; metrics."""
