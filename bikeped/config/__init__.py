"""The whole configuration, as typed sections: load, check, override, hash."""

from bikeped.config.build import (
    framing,
    ground_camera,
    road_region,
    rule_settings,
    tracker_settings,
)
from bikeped.config.load import (
    LoadedConfig,
    config_hash,
    default_config_path,
    load_config,
    load_decision,
    parse_config,
    parse_decision,
)
from bikeped.config.schema import CameraConfig, DecisionConfig

__all__ = [
    "CameraConfig",
    "DecisionConfig",
    "LoadedConfig",
    "config_hash",
    "default_config_path",
    "framing",
    "ground_camera",
    "load_config",
    "load_decision",
    "parse_config",
    "parse_decision",
    "road_region",
    "rule_settings",
    "tracker_settings",
]
