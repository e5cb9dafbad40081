"""Every key of `config.yaml`: its type, range and default, and below it what it means.

The texts below the keys go into `docs/configuration.md` and `bikeped config schema`. Settings that
the paper gives in frames stay in frames here and become seconds once, at `decision.nominal_fps`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bikeped.config.output_sections import (
    AuditConfig,
    FeedbackConfig,
    LampConfig,
    MqttConfig,
    Section,
    WebConfig,
)

# Finite by construction: msgspec refuses NaN only where a bound is given, so every float has one.
Radial = Annotated[float, Meta(ge=-10, le=10)]
Projection = Literal[
    "equidistant",
    "equisolid",
    "stereographic",
    "orthographic",
    "perspective",
    "linear",
    "equalarea",
]


class CameraConfig(Section, frozen=True):
    """The camera: its source, its lens, and its pose above the ground."""

    source: Annotated[str, Meta(min_length=1)] = "/dev/video0"
    """V4L2 device, best by its lasting name below /dev/v4l/by-id; video file, folder of images, or
    rtsp:// or http:// address; `bikeped run` wants this key in the file"""
    username: Annotated[str, Meta(min_length=1)] | None = None
    """user name of a network camera; null: none, or the one in the address"""
    password_file: str | None = None
    """file whose first line is the password of a network camera; null: none, or the one in the
    address"""
    width: Annotated[int, Meta(ge=16, le=16384)] = 3840
    """sensor width requested from the camera, pixels"""
    height: Annotated[int, Meta(ge=16, le=16384)] = 2160
    """sensor height requested from the camera, pixels"""
    fps: Annotated[float, Meta(ge=1, le=240)] = 30.0
    """frame rate requested from the camera, frames per second"""
    fourcc: Annotated[str, Meta(min_length=4, max_length=4)] = "MJPG"
    """V4L2 pixel format; MJPG is passed undecoded"""
    calibration: str | None = None
    """calibration file with projection, centre, focal length and radial terms, relative to this
    file; null uses only the keys below"""
    projection: Projection | None = None
    """lens model; linear is equidistant, equalarea is equisolid, perspective is an ordinary lens;
    null takes the calibration's, or else equidistant"""
    fov_deg: Annotated[float, Meta(gt=0, le=300)] | None = None
    """field of view, degrees; null takes the calibration's"""
    radius_px: Annotated[float, Meta(gt=0, le=100000)] | None = None
    """image circle radius at the edge of the field of view, crop pixels; gives the focal length;
    null takes the calibration's focal length"""
    cx: Annotated[float, Meta(ge=-100000, le=100000)] | None = None
    """optical centre u in the crop, pixels; null takes the calibration's, or else the middle"""
    cy: Annotated[float, Meta(ge=-100000, le=100000)] | None = None
    """optical centre v in the crop, pixels; null takes the calibration's, or else the middle"""
    k1: Radial | None = None
    """radial term of theta^3; null: calibration"""
    k2: Radial | None = None
    """radial term of theta^5; null: calibration"""
    k3: Radial | None = None
    """radial term of theta^7; null: calibration"""
    k4: Radial | None = None
    """radial term of theta^9; null: calibration"""
    pad_size: Annotated[int, Meta(ge=16, le=32768)] | None = 3840
    """side of the black square that the frame is centred in, pixels; null: none"""
    crop_size: Annotated[int, Meta(ge=16, le=32768)] | None = 3500
    """side of the square cut from its middle, pixels; null: none"""
    height_m: Annotated[float, Meta(gt=0, le=100)] = 3.6576
    """height of the lens above the ground, metres"""
    pitch_deg: Annotated[float, Meta(ge=-90, le=90)] = 0.0
    """pitch, degrees; 0 is level, negative looks down"""
    heading_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    """turns the ground frame to the right of the optical axis, degrees; 0 keeps x forward"""
    reference: Annotated[str, Meta(min_length=1)] | None = None
    """file of what the camera saw when it was aligned, written with an alignment, relative to this
    file; by it the service notices that the camera has moved; null: by the first 2 s of pictures"""
    table_step_px: Annotated[int, Meta(ge=2, le=64)] = 8
    """spacing of the ground table's lattice, crop pixels"""
    stale_after_s: Annotated[float, Meta(ge=0.05, le=2)] = 0.5
    """no frame for this long is a FAULT and a new capture, seconds"""
    hang_after_s: Annotated[float, Meta(ge=1, le=60)] = 2.0
    """a read that has not returned for this long is left behind and the camera opened anew; where
    that does not work either, the process ends, and systemd starts it again, seconds"""


class DetectionConfig(Section, frozen=True):
    """The detector: model file, output layout, and which detections are kept."""

    model: str | None = None
    """model file, .onnx or .engine, relative to this file; bundled: the small one that comes with
    bikeped, trained on drawn streets only, for demo and self-test, never for a street; null:
    none"""
    sha256: Annotated[str, Meta(pattern="^[0-9a-fA-F]{64}$")] | None = None
    """SHA-256 of the model file and of the files beside it that hold its weights, refused when
    different; written when a configuration is promoted; null: any (the bundled model is always
    checked)"""
    layout: Literal["auto", "yolov5", "yolov8", "end2end", "yolox", "yolox-decoded"] = "auto"
    """output layout: yolov5 also v7; yolov8 also v9, v11, v12; end2end also v10 and 26; auto tells
    them apart by metadata and shapes"""
    preprocess: Literal["auto", "ultralytics", "yolox", "yolox-legacy"] = "auto"
    """ultralytics: RGB/255, centred letterbox; yolox: BGR 0..255, top-left; yolox-legacy (before
    0.1.1): RGB/255, ImageNet mean and deviation, top-left"""
    region: Literal["auto", "road", "frame"] = "auto"
    """part of the frame that the model gets; road: where road users within decision.max_range_m can
    be, by height and pitch of the camera; frame: all; auto: road where the model's input can have
    that height, which is faster, else frame"""
    confidence: Annotated[float, Meta(ge=0.001, le=0.95)] = 0.1
    """lowest confidence of a detection that is kept"""
    iou: Annotated[float, Meta(ge=0.01, le=1)] = 0.45
    """overlap above which the less confident of two boxes of one class is dropped"""
    merge_overlap: Annotated[float, Meta(ge=0.5, le=1)] = 0.75
    """box voting: a kept box becomes the mean, weighted by confidence, of the boxes of its kind
    that overlap it this much, which reduces box jitter; 1 leaves every box as it is"""
    max_detections: Annotated[int, Meta(ge=1, le=10000)] = 300
    """largest number of detections kept of one frame"""
    pedestrian: tuple[str, ...] = ("person", "pedestrian")
    """model class names that are pedestrians"""
    cyclist: tuple[str, ...] = ("bicycle", "motorcycle", "cyclist")
    """model class names that are cyclists"""
    vehicle: tuple[str, ...] = ("car", "bus", "truck", "vehicle")
    """model class names that are vehicles"""
    rider_overlap: Annotated[float, Meta(ge=0, le=1)] = 0.4
    """share of a person's box, from the waist down, that a cyclist's box must cover for the two to
    be one rider; 1 never joins them"""
    providers: Annotated[tuple[Literal["tensorrt", "cuda", "cpu"], ...], Meta(min_length=1)] = (
        "tensorrt",
        "cuda",
        "cpu",
    )
    """ONNX Runtime execution providers in order; those not present are skipped"""
    engine_cache: Annotated[str, Meta(min_length=1)] = "~/.cache/bikeped/engines"
    """folder for TensorRT engines built from ONNX"""
    threads: Annotated[int, Meta(ge=0, le=256)] = 0
    """CPU threads for inference; 0 lets the runtime choose, and runs two copies of the model with
    half of the cores each on a recording"""
    check_picture: str | None = None
    """picture with known road users that goes through the model every 20 s, .jpg with its .json, as
    bikeped align --check-picture writes them, relative to this file; null: a drawn one for the
    bundled model, and else a frame with confident detections, which is remembered in memory only"""
    silent_after_s: Annotated[float, Meta(ge=0.05, le=2)] = 0.5
    """no detector answer for this long is a FAULT, seconds"""
    hang_after_s: Annotated[float, Meta(ge=1, le=60)] = 15.0
    """an inference that has not returned, or failures only, for this long end the process, and
    systemd starts it again, seconds"""


class TrackingConfig(Section, frozen=True):
    """The tracker, in ground metres."""

    match_radius_m: Annotated[float, Meta(gt=0, le=50)] = 3.0
    """largest distance between a detection and the track that it is matched with, m"""
    max_unseen_s: Annotated[float, Meta(ge=0, le=30)] = 10.0
    """an unseen track coasts at constant velocity this long, s"""
    measurement_noise_pedestrian_m: Annotated[float, Meta(gt=0, le=5)] = 0.10
    """standard deviation of a detection's place, on each axis: the jitter of real boxes at 10 m is
    0.05 to 0.15; a larger one makes tracks calmer and later, m"""
    measurement_noise_cyclist_m: Annotated[float, Meta(gt=0, le=5)] = 0.12
    """the same of cyclists and vehicles, whose boxes are larger, m"""
    acceleration_pedestrian_mps2: Annotated[float, Meta(gt=0, le=50)] = 2.5
    """standard deviation of the acceleration, anew every nominal frame: after a second of it the
    speed has changed by 0.46 m/s, as walkers' do, m/s^2"""
    acceleration_cyclist_mps2: Annotated[float, Meta(gt=0, le=50)] = 5.0
    """the same of cyclists and vehicles: 0.91 m/s after a second, a rider who brakes or turns,
    m/s^2"""
    first_speed_pedestrian_mps: Annotated[float, Meta(gt=0, le=50)] = 2.0
    """standard deviation of the velocity of a new track: a walker's. Steps that need a higher speed
    are believed only when several agree, m/s"""
    first_speed_cyclist_mps: Annotated[float, Meta(gt=0, le=50)] = 6.0
    """the same of cyclists and vehicles, m/s"""
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

    rule: Literal["pairwise", "naive", "ttc", "distance", "predictive"] = "pairwise"
    """closing check: the paper's pairwise one, a baseline, or bikeped's own, predictive, which asks
    for the eight keys from least_closing_mps on, and not for d_min_m to speed_adaptive"""
    memory_frames: Annotated[int, Meta(ge=0, le=3000)] = 58
    """N: a cyclist is remembered this many nominal frames; 0, the paper's rule without memory, is
    for conformance only: `bikeped run` refuses it"""
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
    least_closing_mps: Annotated[float, Meta(ge=0, le=10)] = 0.35
    """rule predictive: slower than this, two do not close in: below a walker's own speed, m/s"""
    least_cycling_mps: Annotated[float, Meta(ge=0, le=10)] = 1.8
    """rule predictive: who rides slower could stop at once, m/s"""
    pass_within_m: Annotated[float, Meta(ge=0, le=25)] = 7.8
    """rule predictive: a pass this near may yet become a contact by a turn, m"""
    pass_growth_mps: Annotated[float, Meta(ge=0, le=5)] = 0.65
    """rule predictive: so much wider a second of time to the pass, which is less sure then, m/s"""
    stopping_share: Annotated[float, Meta(gt=0, le=2)] = 0.55
    """rule predictive: the cyclist's stopping distance is over this share of the gap"""
    contact_within_s: Annotated[float, Meta(gt=0, le=10)] = 5.2
    """rule predictive: or contact, at this closing speed, is nearer than this, s"""
    least_ahead_s: Annotated[float, Meta(ge=0, le=1)] = 0.3
    """rule predictive: the pass is later than this: the hold covers what is nearer, s"""
    stay_margin: Annotated[float, Meta(ge=0, le=0.9)] = 0.1
    """rule predictive: an alert stays on while all this holds with numbers wider by this share"""
    max_unseen_s: Annotated[float, Meta(ge=0, le=2)] = 1.0
    """a track counts, as present, in memory and in a pair, only while seen within this time, s"""
    alert_on_frames: Annotated[int, Meta(ge=1, le=30)] = 2
    """ALERT is shown when the rule says so in this many of the last `alert_window_frames`"""
    alert_window_frames: Annotated[int, Meta(ge=1, le=30)] = 3
    """nominal frames in which `alert_on_frames` are counted"""
    alert_hold_s: Annotated[float, Meta(ge=0, le=2)] = 1.5
    """ALERT is shown for this long after the rule last said so, s"""
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
    max_s: Annotated[float, Meta(ge=0, le=2)] = 0.5
    """never predict farther ahead than this, seconds"""
    camera_offset_s: Annotated[float, Meta(ge=0, le=2)] = 0.0
    """part of the camera's delay that its time stamp does not show, seconds"""


class MonitorConfig(Section, frozen=True):
    """Checks of what was seen: the picture's health, and whether the camera has moved."""

    picture: bool = True
    """judge every picture; off is for tests and drawn recordings, and health then says so"""


class Config(Section, frozen=True):
    """The whole configuration."""

    camera: CameraConfig = msgspec.field(default_factory=CameraConfig)
    detection: DetectionConfig = msgspec.field(default_factory=DetectionConfig)
    tracking: TrackingConfig = msgspec.field(default_factory=TrackingConfig)
    decision: DecisionConfig = msgspec.field(default_factory=DecisionConfig)
    monitor: MonitorConfig = msgspec.field(default_factory=MonitorConfig)
    feedback: FeedbackConfig = msgspec.field(default_factory=FeedbackConfig)
    lamp: LampConfig = msgspec.field(default_factory=LampConfig)
    mqtt: MqttConfig = msgspec.field(default_factory=MqttConfig)
    web: WebConfig = msgspec.field(default_factory=WebConfig)
    audit: AuditConfig = msgspec.field(default_factory=AuditConfig)
    latency: LatencyConfig = msgspec.field(default_factory=LatencyConfig)
    complete: bool = False
    """true, as the last key: the file is whole; a file that was cut off lacks it"""


def sections(
    struct: type[msgspec.Struct], path: str = ""
) -> Iterator[tuple[str, type[msgspec.Struct]]]:
    """(path, section) of a section (its own path is `path`) and of all sections in it, in order."""
    yield path, struct
    for field in msgspec.structs.fields(struct):
        if isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            yield from sections(field.type, f"{path}.{field.name}" if path else field.name)
