"""Pictures for people: the camera's view with what was found, and a bird's-eye radar.

Pure functions over the stage types; only `VideoSink` touches the disk.
"""

from bikeped.view.compose import compose, encode_jpeg
from bikeped.view.moment import GroundToFrame, Moment, ground_projector
from bikeped.view.overlay import draw_banner, draw_overlay
from bikeped.view.radar import RadarFrame, draw_radar
from bikeped.view.sink import VideoSink

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
