"""Every key of `config.yaml`: its type, range, default and meaning.

Here camera and detection; `sections_judge` and `sections_output` have the others. The descriptions
are the source of `docs/configuration.md` and of `bikeped config schema`. Values that the paper
gives in frames stay in frames here (people know them so) and are turned into seconds once, at
`decision.nominal_fps`.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bikeped.config.schema.base import Section
from bikeped.config.schema.decision import DecisionConfig, LatencyConfig, TrackingConfig
from bikeped.config.schema.outputs import (
    AuditConfig,
    FeedbackConfig,
    MqttConfig,
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
    """The camera: where pictures come from, its lens, and how it hangs."""

    source: Annotated[
        str,
        Meta(
            min_length=1,
            description="V4L2 device, video file, folder of images, or rtsp:// or http:// address",
        ),
    ] = "/dev/video0"
    width: Annotated[
        int, Meta(ge=16, le=16384, description="sensor width asked of the camera, pixels")
    ] = 3840
    height: Annotated[
        int, Meta(ge=16, le=16384, description="sensor height asked of the camera, pixels")
    ] = 2160
    fps: Annotated[
        float, Meta(ge=1, le=240, description="frame rate asked of the camera, frames per second")
    ] = 30.0
    fourcc: Annotated[
        str,
        Meta(
            min_length=4,
            max_length=4,
            description="V4L2 pixel format; MJPG is passed undecoded",
        ),
    ] = "MJPG"
    calibration: Annotated[
        str | None,
        Meta(
            description="calibration file with projection, centre, focal length and radial terms, "
            "relative to this file; null uses only the keys below"
        ),
    ] = None
    projection: Annotated[
        Projection | None,
        Meta(
            description="lens model; linear is equidistant, equalarea is equisolid, perspective is "
            "an ordinary lens; null takes the calibration's, or else equidistant"
        ),
    ] = None
    fov_deg: Annotated[
        Annotated[float, Meta(gt=0, le=300)] | None,
        Meta(description="field of view, degrees; null takes the calibration's"),
    ] = None
    radius_px: Annotated[
        Annotated[float, Meta(gt=0, le=100000)] | None,
        Meta(
            description="image circle radius at the edge of the field of view, crop pixels; gives "
            "the focal length; null takes the calibration's focal length",
        ),
    ] = None
    cx: Annotated[
        Annotated[float, Meta(ge=-100000, le=100000)] | None,
        Meta(
            description="optical centre u in the crop, pixels; null takes the calibration's, or "
            "else the middle",
        ),
    ] = None
    cy: Annotated[
        Annotated[float, Meta(ge=-100000, le=100000)] | None,
        Meta(
            description="optical centre v in the crop, pixels; null takes the calibration's, or "
            "else the middle",
        ),
    ] = None
    k1: Annotated[Radial | None, Meta(description="radial term of theta^3; null: calibration")] = (
        None
    )
    k2: Annotated[Radial | None, Meta(description="radial term of theta^5; null: calibration")] = (
        None
    )
    k3: Annotated[Radial | None, Meta(description="radial term of theta^7; null: calibration")] = (
        None
    )
    k4: Annotated[Radial | None, Meta(description="radial term of theta^9; null: calibration")] = (
        None
    )
    pad_size: Annotated[
        Annotated[int, Meta(ge=16, le=32768)] | None,
        Meta(
            description="side of the black square that the frame is centred in, pixels; null: none",
        ),
    ] = 3840
    crop_size: Annotated[
        Annotated[int, Meta(ge=16, le=32768)] | None,
        Meta(
            description="side of the square cut from its middle, pixels; null: none",
        ),
    ] = 3500
    height_m: Annotated[
        float, Meta(gt=0, le=100, description="height of the lens above the ground, metres")
    ] = 3.6576
    pitch_deg: Annotated[
        float,
        Meta(ge=-90, le=90, description="pitch, degrees; 0 is level, negative looks down"),
    ] = 0.0
    heading_deg: Annotated[
        float,
        Meta(
            ge=-360,
            le=360,
            description="turns the ground frame to the right of the optical axis, degrees; 0 keeps "
            "x forward",
        ),
    ] = 0.0
    table_step_px: Annotated[
        int,
        Meta(ge=2, le=64, description="spacing of the ground table's lattice, crop pixels"),
    ] = 8
    stale_after_s: Annotated[
        float,
        Meta(
            gt=0, le=60, description="no frame for this long is a FAULT and a new capture, seconds"
        ),
    ] = 0.5
    hang_after_s: Annotated[
        float,
        Meta(
            ge=1,
            le=600,
            description="a read that has not returned for this long ends the process, so that "
            "systemd starts a fresh one, seconds",
        ),
    ] = 15.0


class DetectionConfig(Section, frozen=True):
    """The detector: the model file, its layout, and what is kept of its answer."""

    model: Annotated[
        str | None,
        Meta(
            description="model file, .onnx or .engine, relative to this file; bundled: the small "
            "one that comes with bikeped, which knows drawn streets only and is for demo and "
            "self-test, never for a street; null: none"
        ),
    ] = None
    sha256: Annotated[
        Annotated[str, Meta(pattern="^[0-9a-fA-F]{64}$")] | None,
        Meta(
            description="SHA-256 of the model file, refused when different; null: any",
        ),
    ] = None
    layout: Annotated[
        Literal["auto", "yolov5", "yolov8", "end2end", "yolox", "yolox-decoded"],
        Meta(
            description="output layout: yolov5 also v7; yolov8 also v9, v11, v12; end2end also v10 "
            "and 26; auto tells them apart by metadata and shapes"
        ),
    ] = "auto"
    preprocess: Annotated[
        Literal["auto", "ultralytics", "yolox", "yolox-legacy"],
        Meta(
            description="ultralytics: RGB/255, centred letterbox; yolox: BGR 0..255, top-left; "
            "yolox-legacy (before 0.1.1): RGB/255, ImageNet mean and deviation, top-left"
        ),
    ] = "auto"
    region: Annotated[
        Literal["auto", "road", "frame"],
        Meta(
            description="what is shown to the model; road: the part where road users within "
            "decision.max_range_m can be, by height and pitch of the camera; frame: all; auto: "
            "road where the model's input can be of that height, which is quicker, else frame"
        ),
    ] = "auto"
    confidence: Annotated[
        float, Meta(ge=0.001, le=1, description="smallest confidence that is kept")
    ] = 0.1
    iou: Annotated[
        float,
        Meta(ge=0.01, le=1, description="overlap above which the weaker of one class is dropped"),
    ] = 0.45
    merge_overlap: Annotated[
        float,
        Meta(
            ge=0.5,
            le=1,
            description="a box that is kept becomes the mean, weighted by confidence, of those of "
            "its kind that overlap it this much, which trembles less; 1 leaves every box as it is",
        ),
    ] = 0.75
    max_detections: Annotated[
        int, Meta(ge=1, le=10000, description="most detections kept of one frame")
    ] = 300
    pedestrian: Annotated[
        tuple[str, ...], Meta(description="model class names that are pedestrians")
    ] = ("person", "pedestrian")
    cyclist: Annotated[tuple[str, ...], Meta(description="model class names that are cyclists")] = (
        "bicycle",
        "motorcycle",
        "cyclist",
    )
    vehicle: Annotated[tuple[str, ...], Meta(description="model class names that are vehicles")] = (
        "car",
        "bus",
        "truck",
        "vehicle",
    )
    rider_overlap: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="share of a person's box, from the waist down, that a cyclist's box must "
            "cover for the two to be one rider; 1 never joins them",
        ),
    ] = 0.4
    providers: Annotated[
        tuple[Literal["tensorrt", "cuda", "cpu"], ...],
        Meta(
            min_length=1,
            description="ONNX Runtime execution providers in order; those not present are skipped",
        ),
    ] = ("tensorrt", "cuda", "cpu")
    engine_cache: Annotated[
        str, Meta(min_length=1, description="folder for TensorRT engines built from ONNX")
    ] = "~/.cache/bikeped/engines"
    threads: Annotated[
        int,
        Meta(
            ge=0,
            le=256,
            description="CPU threads for inference; 0 lets the runtime choose, and lets a "
            "recording be looked at by two copies of the model with half of the cores each",
        ),
    ] = 0
    silent_after_s: Annotated[
        float,
        Meta(
            gt=0,
            le=60,
            description="no detector answer for this long is a FAULT, seconds",
        ),
    ] = 0.5


class Config(Section, frozen=True):
    """The whole configuration."""

    camera: CameraConfig = msgspec.field(default_factory=CameraConfig)
    detection: DetectionConfig = msgspec.field(default_factory=DetectionConfig)
    tracking: TrackingConfig = msgspec.field(default_factory=TrackingConfig)
    decision: DecisionConfig = msgspec.field(default_factory=DecisionConfig)
    feedback: FeedbackConfig = msgspec.field(default_factory=FeedbackConfig)
    mqtt: MqttConfig = msgspec.field(default_factory=MqttConfig)
    web: WebConfig = msgspec.field(default_factory=WebConfig)
    audit: AuditConfig = msgspec.field(default_factory=AuditConfig)
    latency: LatencyConfig = msgspec.field(default_factory=LatencyConfig)
