"""The three-stage decision. Pure: positions and times in, state and reasons out."""

from bikeped.decision.decider import Decider, explain, pair_metrics, select_pair
from bikeped.decision.rules import (
    PairChecks,
    RuleSettings,
    evaluate_rule,
    frame_mask,
    is_remembered,
    resolve_state,
)
from bikeped.decision.track_rows import Pairs, TrackRows, pair_rows

__all__ = [
    "Decider",
    "PairChecks",
    "Pairs",
    "RuleSettings",
    "TrackRows",
    "evaluate_rule",
    "explain",
    "frame_mask",
    "is_remembered",
    "pair_metrics",
    "pair_rows",
    "resolve_state",
    "select_pair",
]
