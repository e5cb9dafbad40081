"""The whole configuration, as typed sections: load, check, override, hash."""

from bikeped.config.build import (
    framing,
    ground_camera,
    road_region,
    rule_settings,
    tracker_settings,
)
from bikeped.config.calibration_file import load_calibration
from bikeped.config.load import (
    LoadedConfig,
    config_hash,
    default_config_path,
    load_config,
    load_decision,
    parse_config,
    parse_decision,
)
from bikeped.config.schema.decision import DecisionConfig
from bikeped.config.schema.inputs import CameraConfig, Config
from bikeped.config.schema.outputs import (
    AuditConfig,
    FeedbackConfig,
    GpioConfig,
    MqttConfig,
    SoundConfig,
    UsbConfig,
    WebConfig,
    is_loopback,
)
from bikeped.config.validate import known_keys

__all__ = [
    "AuditConfig",
    "CameraConfig",
    "Config",
    "DecisionConfig",
    "FeedbackConfig",
    "GpioConfig",
    "LoadedConfig",
    "MqttConfig",
    "SoundConfig",
    "UsbConfig",
    "WebConfig",
    "config_hash",
    "default_config_path",
    "framing",
    "ground_camera",
    "is_loopback",
    "known_keys",
    "load_calibration",
    "load_config",
    "load_decision",
    "parse_config",
    "parse_decision",
    "road_region",
    "rule_settings",
    "tracker_settings",
]
