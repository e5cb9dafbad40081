"""Lens, camera, framing and ground table: pixels to metres and back. Pure."""

from bikeped.geometry.camera import CameraPose, GroundCamera, GroundTable
from bikeped.geometry.framing import Framing, road_region
from bikeped.geometry.lens import Lens, Projection, canonical_projection

__all__ = [
    "CameraPose",
    "Framing",
    "GroundCamera",
    "GroundTable",
    "Lens",
    "Projection",
    "canonical_projection",
    "road_region",
]
