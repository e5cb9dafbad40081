"""Lens, camera, framing and ground table: pixels to metres and back. Pure."""

from bikeped.geometry.camera import CameraPose, GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.geometry.ground import GroundTable
from bikeped.geometry.lens import Lens, Projection, canonical_projection
from bikeped.geometry.road import road_region

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
