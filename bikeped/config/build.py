"""From configuration sections to the settings of geometry, tracking and decision.

Settings in nominal frames become seconds here, once.
"""

from __future__ import annotations

import math

from bikeped.config.lens_check import Calibration
from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig, TrackingConfig
from bikeped.decision.predictive import PredictiveSettings
from bikeped.decision.rules import RuleSettings
from bikeped.decision.shown import ShownSettings
from bikeped.errors import ConfigError, GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.geometry.framing import road_region as region_of
from bikeped.geometry.lens import Lens, canonical_projection
from bikeped.tracking.batch_tracker import TrackerSettings
from bikeped.tracking.kalman import MotionNoise
from bikeped.types import Region


def rule_settings(decision: DecisionConfig, speed_window_frames: int = 4) -> RuleSettings:
    """The decision's parameters in seconds.

    A cyclist's speed is the displacement between positions `speed_window_frames` nominal frames
    apart (definitions, section 8: 4); on the pole it is `tracking.speed_window_frames`.
    """
    fps = decision.nominal_fps
    return RuleSettings(
        rule=decision.rule,
        memory_s=decision.memory_frames / fps,
        d_min_m=decision.d_min_m,
        d_max_m=decision.d_max_m,
        min_displacement_m=decision.min_displacement_m,
        lookback_s=decision.lookback_frames / fps,
        max_range_m=decision.max_range_m,
        speed_adaptive=decision.speed_adaptive,
        reaction_s=decision.reaction_s,
        deceleration_mps2=decision.deceleration_mps2,
        speed_window_s=speed_window_frames / fps,
        ttc_s=decision.ttc_s,
        max_unseen_s=decision.max_unseen_s,
        predictive=PredictiveSettings(
            least_closing_mps=decision.least_closing_mps,
            least_cycling_mps=decision.least_cycling_mps,
            pass_within_m=decision.pass_within_m,
            pass_growth_mps=decision.pass_growth_mps,
            stopping_share=decision.stopping_share,
            contact_within_s=decision.contact_within_s,
            least_ahead_s=decision.least_ahead_s,
            stay_margin=decision.stay_margin,
        ),
        shown=ShownSettings(
            on_frames=decision.alert_on_frames,
            window_s=(decision.alert_window_frames - 0.5) / fps,
            hold_s=decision.alert_hold_s,
        ),
    )


#: Tracks at a time, so that ghosts of a detector gone wrong do not pile up.
MAX_TRACKS = 256


def tracker_settings(
    tracking: TrackingConfig,
    nominal_fps: float = 30.0,
    acceleration: bool = False,
    cyclist_box_includes_rider: bool = False,
) -> TrackerSettings:
    """The tracker's parameters; `acceleration` for second-order prediction.

    `cyclist_box_includes_rider`: as `TrackerSettings` has it.
    """
    return TrackerSettings(
        match_radius_m=tracking.match_radius_m,
        max_unseen_s=tracking.max_unseen_s,
        motion=motion_noise(tracking),
        frame_s=1 / nominal_fps,
        confirm_hits=tracking.confirm_hits,
        max_speed_mps=(
            tracking.max_speed_pedestrian_mps,
            tracking.max_speed_cyclist_mps,
            tracking.max_speed_vehicle_mps,
        ),
        position_noise_m=tracking.position_noise_m,
        acceleration=acceleration,
        max_range_m=tracking.max_range_m,
        rider_radius_m=tracking.rider_radius_m,
        cyclist_box_includes_rider=cyclist_box_includes_rider,
        max_tracks=MAX_TRACKS,
    )


def motion_noise(tracking: TrackingConfig) -> MotionNoise:
    """The tracker's filter; vehicles, on which nothing is decided, move as cyclists."""

    def by_kind(pedestrian: float, cyclist: float) -> tuple[float, float, float]:
        return pedestrian, cyclist, cyclist

    return MotionNoise(
        by_kind(tracking.measurement_noise_pedestrian_m, tracking.measurement_noise_cyclist_m),
        by_kind(tracking.acceleration_pedestrian_mps2, tracking.acceleration_cyclist_mps2),
        by_kind(tracking.first_speed_pedestrian_mps, tracking.first_speed_cyclist_mps),
    )


def framing(loaded: LoadedConfig) -> Framing:
    """How the sensor image lies in the crop; ConfigError when the sizes do not fit."""
    camera = loaded.config.camera
    try:
        return Framing(camera.width, camera.height, camera.pad_size, camera.crop_size)
    except GeometryError as error:
        raise ConfigError(f"{loaded.source}: {error}") from error


def ground_camera(loaded: LoadedConfig) -> GroundCamera:
    """The camera above the ground: calibration, overridden by the keys of the camera section.

    `radius_px` with `fov_deg` gives the focal length where it is set, as an installer measures it;
    else the calibration does. Raises ConfigError when they describe no camera.
    """
    camera, frame = loaded.config.camera, framing(loaded)
    width, height = frame.crop_wh
    # Without a calibration radius_px and fov_deg are set: `validate.check_together`.
    measured = loaded.calibration or Calibration(
        model="equidistant", cx=(width - 1) / 2, cy=(height - 1) / 2, focal_length=0, fov_deg=0
    )

    def chosen(key: str) -> float:
        value = getattr(camera, key)
        return float(getattr(measured, key) if value is None else value)

    k = (chosen("k1"), chosen("k2"), chosen("k3"), chosen("k4"))
    fov_deg = chosen("fov_deg")
    try:
        name = canonical_projection(camera.projection or measured.model)
        if camera.radius_px is not None:
            lens = Lens.from_circle(name, camera.radius_px, fov_deg, k)
        else:
            lens = Lens(name, measured.focal_length, math.radians(fov_deg) / 2, k)
        return GroundCamera(
            lens=lens,
            cx=chosen("cx"),
            cy=chosen("cy"),
            height_m=camera.height_m,
            pitch_deg=camera.pitch_deg,
            heading_deg=camera.heading_deg,
            window_px=frame.window_px,
        )
    except GeometryError as error:
        raise ConfigError(f"{loaded.source}: camera: {error}") from error


def road_region(loaded: LoadedConfig) -> Region:
    """The part of the camera's frames that road users within the decision's range can be in.

    Raises ConfigError as `ground_camera` does.
    """
    return region_of(ground_camera(loaded), framing(loaded), loaded.config.decision.max_range_m)
