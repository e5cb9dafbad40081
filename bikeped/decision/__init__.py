"""The three-stage decision. Pure: positions and times in, state and reasons out."""

from bikeped.decision.decider import Decider, chosen_pair, explain, pair_numbers
from bikeped.decision.rules import PairVerdicts, RuleSettings, judge
from bikeped.decision.stages import frames_with, remembered, resolve
from bikeped.decision.track_rows import Pairs, TrackRows, pair_rows

__all__ = [
    "Decider",
    "PairVerdicts",
    "Pairs",
    "RuleSettings",
    "TrackRows",
    "chosen_pair",
    "explain",
    "frames_with",
    "judge",
    "pair_numbers",
    "pair_rows",
    "remembered",
    "resolve",
]
