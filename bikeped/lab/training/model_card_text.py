"""The model card as Markdown, from the card's figures; the text is in templates/model_card.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bikeped.lab.training.model_card import WARNED
from bikeped.templates import render

TARGET_RECALL, TARGET_FALSE = 0.95, 1.0  #: within 15 m; per 100 frames
_UNTRAINED_AP = 0.2  #: a lower average precision of all road users says little


def render_card(card: Mapping[str, Any]) -> str:
    """Markdown; `card` is what `scripts/train-detector` writes into small.json."""
    values: dict[str, Any] = {"reached": meets_target(card["configured_camera"])}
    if "experiment" in card:
        runs = [card["experiment"][name]["road_users"] for name in ("ordinary", "augmented")]
        both = zip(*(run["rows"] for run in runs), strict=True)
        values["pairs"] = [(one["name"], one, other) for one, other in both]
        values["undertrained"] = max(run["all"]["ap"] or 0.0 for run in runs) < _UNTRAINED_AP
    return render(
        "model_card.md",
        Path(__file__).parent / "templates",
        target_recall=TARGET_RECALL,
        target_false=TARGET_FALSE,
        **values,
        **card,
    )


def meets_target(test: Mapping[str, Any]) -> bool:
    """Whether the figures of one test of the card are as good as the targets."""
    recalls = (test["kinds"][kind.label]["within_15_m"]["recall"] for kind in WARNED)
    false = test["false_pedestrian_or_cyclist_per_100_frames"]
    return bool(min(recalls) >= TARGET_RECALL and false <= TARGET_FALSE)
