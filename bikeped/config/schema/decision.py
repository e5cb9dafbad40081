"""Keys of `config.yaml` that say how it is judged: tracker, rule, latency. (See `sections`.)"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from bikeped.config.schema.base import Section


class TrackingConfig(Section, frozen=True):
    """The tracker, in ground metres."""

    match_radius_m: Annotated[
        float, Meta(gt=0, le=50, description="farthest that a detection may lie from its track, m")
    ] = 3.0
    max_unseen_s: Annotated[
        float,
        Meta(ge=0, le=60, description="an unseen track coasts at constant velocity this long, s"),
    ] = 10.0
    velocity_weight: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="weight of the newest step in the smoothed velocity, per nominal frame; "
            "the paper's simulation has 0.5, with which the noise of real boxes throws lost tracks "
            "far",
        ),
    ] = 0.15
    position_weight: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="weight of a detection against the place where its track was expected, per "
            "nominal frame; 1, as in the paper's simulation: a track jumps as its boxes do, and "
            "two who close in seem not to",
        ),
    ] = 0.2
    speed_window_frames: Annotated[
        int,
        Meta(
            ge=1,
            le=60,
            description="speed and velocity are the displacement over these nominal frames: a "
            "cyclist's in the stopping distance, and the published one",
        ),
    ] = 4
    history_frames: Annotated[
        int, Meta(ge=2, le=300, description="positions kept and published of each track")
    ] = 30
    confirm_hits: Annotated[
        int, Meta(ge=1, le=30, description="matches before a track counts as present")
    ] = 2
    rider_radius_m: Annotated[
        float,
        Meta(
            ge=0,
            le=5,
            description="a person without a track, this near to a cyclist's track without a "
            "detection, is that cyclist, and the reverse; 0: never, m",
        ),
    ] = 1.0
    max_range_m: Annotated[
        float,
        Meta(gt=0, le=1000, description="nothing farther from the camera is tracked, m"),
    ] = 60.0
    max_speed_pedestrian_mps: Annotated[
        float, Meta(gt=0, le=100, description="speed gate of pedestrians, m/s")
    ] = 6.0
    max_speed_cyclist_mps: Annotated[
        float, Meta(gt=0, le=100, description="speed gate of cyclists, m/s")
    ] = 20.0
    max_speed_vehicle_mps: Annotated[
        float, Meta(gt=0, le=100, description="speed gate of vehicles, m/s")
    ] = 40.0
    position_noise_m: Annotated[
        float,
        Meta(
            ge=0,
            le=10,
            description="measurement noise that the speed gate allows on top of the speed, m",
        ),
    ] = 0.75


class DecisionConfig(Section, frozen=True):
    """The three-stage rule. The defaults are the paper's selected configuration."""

    rule: Annotated[
        Literal["pairwise", "naive", "ttc", "distance"],
        Meta(description="closing check: the paper's pairwise one, or a baseline"),
    ] = "pairwise"
    memory_frames: Annotated[
        int,
        Meta(ge=0, le=3000, description="N: a cyclist is remembered this many nominal frames"),
    ] = 58
    d_min_m: Annotated[
        float, Meta(ge=0, le=100, description="nearest pair distance that can alert, m")
    ] = 1.9
    d_max_m: Annotated[
        float, Meta(gt=0, le=100, description="farthest pair distance that can alert, m")
    ] = 24.8
    min_displacement_m: Annotated[
        float,
        Meta(ge=0, le=10, description="least way of the cyclist over the lookback that counts, m"),
    ] = 0.147
    lookback_frames: Annotated[
        int, Meta(ge=1, le=60, description="k: the lookback, in nominal frames")
    ] = 2
    max_range_m: Annotated[
        float,
        Meta(gt=0, le=1000, description="pairs farther from the camera are not judged, m"),
    ] = 25.0
    speed_adaptive: Annotated[
        bool, Meta(description="raise d_max to the cyclist's stopping distance")
    ] = True
    reaction_s: Annotated[
        float, Meta(ge=0, le=10, description="cyclist's reaction time in the stopping distance, s")
    ] = 0.84
    deceleration_mps2: Annotated[
        float,
        Meta(gt=0, le=20, description="cyclist's deceleration in the stopping distance, m/s^2"),
    ] = 1.96
    ttc_s: Annotated[
        float, Meta(gt=0, le=60, description="time to collision below which rule ttc fires, s")
    ] = 3.0
    nominal_fps: Annotated[
        float,
        Meta(ge=1, le=240, description="turns settings in frames into seconds, once"),
    ] = 30.0


class LatencyConfig(Section, frozen=True):
    """Compensation of the time between capture and decision."""

    compensation: Annotated[
        Literal["off", "measured", "frames"],
        Meta(
            description="off; predict ahead by the measured capture age; or by a fixed number of "
            "frames"
        ),
    ] = "off"
    frames: Annotated[
        int, Meta(ge=0, le=60, description="nominal frames to predict ahead with frames")
    ] = 0
    order: Annotated[
        Literal[1, 2], Meta(description="1 uses velocity, 2 acceleration too (worse: paper)")
    ] = 1
    max_s: Annotated[
        float, Meta(ge=0, le=5, description="never predict farther ahead than this, seconds")
    ] = 0.5
    camera_offset_s: Annotated[
        float,
        Meta(
            ge=0,
            le=2,
            description="part of the camera's delay that its time stamp does not show, seconds",
        ),
    ] = 0.0
