"""The three-stage decision. Pure: positions and times in, state and reasons out."""

from bikeped.decision.decider import Decider, chosen_pair, explain, pair_numbers
from bikeped.decision.rows import Pairs, TrackRows, pair_rows
from bikeped.decision.rules import PairVerdicts, RuleSettings, judge
from bikeped.decision.stages import frames_with, remembered, resolve

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
