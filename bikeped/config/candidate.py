"""A decision section on its own: what a candidate file holds, and what `--set` makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from bikeped.config.load import _apply, _explain, _yaml_mapping, read_text
from bikeped.config.schema.decision import DecisionConfig
from bikeped.config.schema.inputs import Config
from bikeped.errors import ConfigError


def load_decision(path: Path, overrides: Sequence[str] = ()) -> DecisionConfig:
    """The decision section of a file that holds only it, or of a whole configuration.

    Keys that the section leaves out take their defaults, as they do in config.yaml. `overrides`
    are `decision.KEY=VALUE`. Raises ConfigError naming the file, the key and the remedy.
    """
    return parse_decision(read_text(path, "check the path"), str(path), overrides)


def parse_decision(text: str, source: str, overrides: Sequence[str] = ()) -> DecisionConfig:
    """As `load_decision`, from YAML text; `source` names it in errors."""
    data = _yaml_mapping(text, source)
    if not isinstance(data.get("decision"), dict):
        raise ConfigError(
            f"{source}: decision: missing; a candidate holds a decision: section, or is a whole "
            "configuration"
        )
    for override in overrides:
        _apply(data, override)
    try:
        # The other sections are checked too: a slip in a whole configuration is not passed over.
        decision = msgspec.convert(data, Config, strict=True).decision
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {_explain(error, data)}") from error
    except (ValueError, OverflowError, RecursionError) as error:
        raise ConfigError(f"{source}: {error}; see bikeped config schema") from error
    if decision.d_min_m > decision.d_max_m:
        raise ConfigError(
            f"{source}: decision.d_min_m: {decision.d_min_m:g} is above decision.d_max_m "
            f"{decision.d_max_m:g}; exchange them"
        )
    return decision
