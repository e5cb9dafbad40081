"""Pictures for people: the camera's view with what was found, and a bird's-eye radar.

Pure functions over the stage types; only `VideoSink` touches the disk.
"""

from bikeped.overlay.camera_view import draw_banner, draw_overlay
from bikeped.overlay.compose import compose, encode_jpeg
from bikeped.overlay.overlay_data import GroundToFrame, Moment, ground_projector
from bikeped.overlay.radar import RadarFrame, draw_radar
from bikeped.overlay.video_writer import VideoSink

__all__ = [
    "GroundToFrame",
    "Moment",
    "RadarFrame",
    "VideoSink",
    "compose",
    "draw_banner",
    "draw_overlay",
    "draw_radar",
    "encode_jpeg",
    "ground_projector",
]
