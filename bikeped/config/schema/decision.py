"""Keys of `config.yaml` about tracker, rule and latency; see `inputs` for how they are written."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from bikeped.config.schema.base import Section


class TrackingConfig(Section, frozen=True):
    """The tracker, in ground metres."""

    match_radius_m: Annotated[float, Meta(gt=0, le=50)] = 3.0
    """largest distance between a detection and the track that it is matched with, m"""
    max_unseen_s: Annotated[float, Meta(ge=0, le=60)] = 10.0
    """an unseen track coasts at constant velocity this long, s"""
    velocity_weight: Annotated[float, Meta(gt=0, le=1)] = 0.15
    """weight of the newest step in the smoothed velocity, per nominal frame; the paper's simulation
    has 0.5, with which the noise of real boxes carries lost tracks far away"""
    position_weight: Annotated[float, Meta(gt=0, le=1)] = 0.2
    """weight of a detection against the predicted position of its track, per nominal frame; with 1,
    as in the paper's simulation, a track jumps as its boxes do, which can hide that a pair closes
    in"""
    speed_window_frames: Annotated[int, Meta(ge=1, le=60)] = 4
    """speed and velocity are the displacement over these nominal frames: a cyclist's in the
    stopping distance, and the published one"""
    history_frames: Annotated[int, Meta(ge=2, le=300)] = 30
    """positions kept and published of each track"""
    confirm_hits: Annotated[int, Meta(ge=1, le=30)] = 2
    """matches before a track counts as present"""
    rider_radius_m: Annotated[float, Meta(ge=0, le=5)] = 1.0
    """a person without a track, this near to a cyclist's track without a detection, is that
    cyclist, and the reverse; 0: never, m"""
    max_range_m: Annotated[float, Meta(gt=0, le=1000)] = 60.0
    """detections farther from the camera are not tracked, m"""
    max_speed_pedestrian_mps: Annotated[float, Meta(gt=0, le=100)] = 6.0
    """speed gate of pedestrians, m/s"""
    max_speed_cyclist_mps: Annotated[float, Meta(gt=0, le=100)] = 20.0
    """speed gate of cyclists, m/s"""
    max_speed_vehicle_mps: Annotated[float, Meta(gt=0, le=100)] = 40.0
    """speed gate of vehicles, m/s"""
    position_noise_m: Annotated[float, Meta(ge=0, le=10)] = 0.75
    """measurement noise that the speed gate allows on top of the speed, m"""


class DecisionConfig(Section, frozen=True):
    """The three-stage rule. The defaults are the paper's selected configuration."""

    rule: Literal["pairwise", "naive", "ttc", "distance"] = "pairwise"
    """closing check: the paper's pairwise one, or a baseline"""
    memory_frames: Annotated[int, Meta(ge=0, le=3000)] = 58
    """N: a cyclist is remembered this many nominal frames"""
    d_min_m: Annotated[float, Meta(ge=0, le=100)] = 1.9
    """nearest pair distance that can alert, m"""
    d_max_m: Annotated[float, Meta(gt=0, le=100)] = 24.8
    """farthest pair distance that can alert, m"""
    min_displacement_m: Annotated[float, Meta(ge=0, le=10)] = 0.147
    """smallest displacement of the cyclist over the lookback that counts as moving, m"""
    lookback_frames: Annotated[int, Meta(ge=1, le=60)] = 2
    """k: the lookback, in nominal frames"""
    max_range_m: Annotated[float, Meta(gt=0, le=1000)] = 25.0
    """pairs farther from the camera are not evaluated, m"""
    speed_adaptive: bool = True
    """raise d_max to the cyclist's stopping distance"""
    reaction_s: Annotated[float, Meta(ge=0, le=10)] = 0.84
    """cyclist's reaction time in the stopping distance, s"""
    deceleration_mps2: Annotated[float, Meta(gt=0, le=20)] = 1.96
    """cyclist's deceleration in the stopping distance, m/s^2"""
    ttc_s: Annotated[float, Meta(gt=0, le=60)] = 3.0
    """time to collision below which rule ttc fires, s"""
    nominal_fps: Annotated[float, Meta(ge=1, le=240)] = 30.0
    """turns settings in frames into seconds, once"""


class LatencyConfig(Section, frozen=True):
    """Compensation of the time between capture and decision."""

    compensation: Literal["off", "measured", "frames"] = "off"
    """off; predict ahead by the measured capture age; or by a fixed number of frames"""
    frames: Annotated[int, Meta(ge=0, le=60)] = 0
    """nominal frames to predict ahead, with compensation: frames"""
    order: Literal[1, 2] = 1
    """1 predicts with velocity, 2 also with acceleration (worse, says the paper)"""
    max_s: Annotated[float, Meta(ge=0, le=5)] = 0.5
    """never predict farther ahead than this, seconds"""
    camera_offset_s: Annotated[float, Meta(ge=0, le=2)] = 0.0
    """part of the camera's delay that its time stamp does not show, seconds"""
