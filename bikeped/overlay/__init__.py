"""Pictures for people: the camera's view with what was found, and a bird's-eye radar.

Pure functions over the stage types; only `VideoWriter` writes to disk.
"""

from bikeped.overlay.camera_view import draw_banner, draw_overlay
from bikeped.overlay.compose import compose, encode_jpeg
from bikeped.overlay.overlay_data import GroundToFrame, OverlayData, ground_projector
from bikeped.overlay.radar import RadarProjection, draw_radar
from bikeped.overlay.video_writer import VideoWriter

__all__ = [
    "GroundToFrame",
    "OverlayData",
    "RadarProjection",
    "VideoWriter",
    "compose",
    "draw_banner",
    "draw_overlay",
    "draw_radar",
    "encode_jpeg",
    "ground_projector",
]
