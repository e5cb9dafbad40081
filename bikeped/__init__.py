"""bikeped: warns cyclists and pedestrians at a crossing of one another."""

__version__ = "0.1.1"
