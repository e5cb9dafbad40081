"""The model card for people, from the card's numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bikeped.types import Kind

TARGET_RECALL, TARGET_FALSE = 0.95, 1.0
_UNTRAINED_AP = 0.2  #: of all road users: less is no trained network
_WALKS_AND_RIDES = (Kind.PEDESTRIAN, Kind.CYCLIST)
_FALSE = "false_pedestrian_or_cyclist_per_100_frames"

_HEAD = """# The small detector that comes with bikeped

A network of {weights:,} weights that finds pedestrians, cyclists (bicycle and rider in one box) and
vehicles in **drawn** fisheye pictures. `detection.model: bundled` names it: `{int8_file}`
({int8_megabytes:.2f} MB) on a processor, `{file}` ({megabytes:.2f} MB) on a GPU.

## For what, and not for what

It is for the demo, for the self-test of an installation (does the chain run, how fast) and for
pixel conformance, where the chain from pixels to decision is held against a known world.

**It must not be used for a street.** It has never seen a photograph. What it makes of a real
picture is unknown, and nobody may be warned, or not warned, by it. `bikeped run` and `bikeped
doctor` say so where it is configured.

## What it was trained on

{pictures} pictures drawn by `bikeped.lab.rendering` ({objects} objects), and nothing else: no
photograph, no other network's weights. {configured:.0%} were seen by the configured camera from
varied spots, the others through fisheyes of all kinds (150 to 205 degrees, four projections, 2.6
to 5.5 m high).
There is more of what is hard to tell than in the streets it is measured on: {mix}.

| | |
| --- | --- |
| command | `{command}` |
| sources | bikeped {bikeped}, commit {commit}{measured} |
| seeds | pictures {seed_data}, training {seed}; validation and tests from seeds of their own |
| drawing | {drawing_min:.0f} min{drawing_note} |
| training | {steps} steps, {training_min:.0f} min |
| first {packed:.0%} | {squares} squares of {side} pixels{digits}; {things:.0%} around things |
| then | {windows} windows of 480 x 288 pixels a step |
| its mistakes | {mistakes} |
| machine | {machine}; PyTorch {torch} on the CPU, two threads{beside} |

The input is RGB / 255, the picture centred on grey 114, with any sides that are multiples of 32:
{input} pixels for a whole frame ({macs:.2f} billion multiplications), {road} for the road of the
configured camera ({road_macs:.2f}; `detection.region: auto` shows a camera's road and nothing
else). The output is laid out as `yolov8`. In `{int8_file}` weights and what passes between layers
are whole numbers of eight bits (weights: seven), their steps taken from about {int8_pictures} of
the pictures above; the first layer, scores and edges are not. The scores of each class are shifted
so that the default `detection.confidence` of {confidence} is the one chosen for it on
{validation} validation pictures, where at most {most_false} a 100 frames were
false{choice}; a score is no probability.

## What it is worth

Measured with `{int8_file}` through `bikeped.detection` at `detection.confidence` {confidence}, on
pictures drawn at 1920 x 1080 from seeds, places and lights of which training and validation saw
none, JPEG-encoded as a camera's; the model was shown the road of each. An object counts where at
least 30 % of it shows and its box is 5 pixels wide at 960 across (what benchmarks call reasonable
is 65 %: told apart below); it is found where a box of its kind overlaps it by half. A detection is
false where it overlaps nobody of its kind by even a tenth, and nobody of another kind by half, or
is the second of one person. The error is that of the box's bottom centre on the ground against the
object's true middle: the near face of what has a depth is always nearer than its middle.

{verdict}
"""

_ROUND = "| {ring} | {objects} | {recall} | {median} | {p90} |"


def render_card(card: Mapping[str, Any]) -> str:
    """Markdown; `card` is what `scripts/train-detector` writes as JSON beside it."""
    model, made = card["model"], card["made"]
    training, test = made["training"], card["configured_camera"]
    settings = training["settings"]
    text = _HEAD.format(
        weights=model["weights"],
        file=model["file"],
        megabytes=model["bytes"] / 1e6,
        int8_file=model["int8_file"],
        int8_megabytes=model["int8_bytes"] / 1e6,
        int8_pictures=model["int8_pictures"],
        pictures=training["pictures"],
        objects=training["objects"],
        command=made["command"],
        bikeped=made["bikeped"],
        commit=made["commit"],
        measured=_measured_by(made),
        seed_data=made["seed_data"],
        seed=settings["seed"],
        configured=made["configured_share"],
        mix=_mix(made["drawing"]["mix"], made["usual_mix"]),
        drawing_min=made["drawing"]["seconds"] / 60,
        drawing_note=made["drawing"].get("note", ""),
        training_min=training["seconds"] / 60,
        steps=settings["steps"],
        windows=settings["pictures"] * settings["windows"],
        mistakes=_false_positives(training),
        packed=settings["packed"],
        squares=settings["pack"]["squares"],
        side=settings["pack"]["side"],
        digits=", in bfloat16" if settings["bfloat16"] else "",
        things=settings["pack"]["furniture"],
        input=" x ".join(str(side) for side in model["input"]),
        macs=model["multiply_adds"] / 1e9,
        road=" x ".join(str(side) for side in model["road_input"]),
        road_macs=model["road_multiply_adds"] / 1e9,
        machine=made["machine"],
        torch=training["torch"],
        beside=made.get("beside", ""),
        confidence=test["confidence"],
        validation=made["validation_pictures"],
        choice=made.get("choice", ""),
        verdict=_verdict(test),
        most_false=", ".join(f"{n:g} {name}s" for name, n in made["most_false"].items()),
    )
    for title, key in (
        ("Through the configured camera", "configured_camera"),
        ("Through other fisheye lenses, heights and pitches", "other_lenses"),
    ):
        text += "\n" + _measured(title, card[key])
    text += "\n" + _exactness(card["configured_camera"])
    text += "\n" + _in_float(model["file"], card["configured_camera_float"])
    if "experiment" in card:
        text += "\n" + _experiment(card["experiment"])
    return text


def _false_positives(training: Mapping[str, Any]) -> str:
    """When it looked at its own pictures, and what came of it."""
    settings, counts = training["settings"], training["mistakes"]
    if not counts:
        return "not looked for"
    shares = " and ".join(f"{share:.0%}" for share in settings["mining"]["after"])
    return (
        f"looked for in all pictures after {shares} of the steps: "
        f"{' and '.join(map(str, counts))} times it took something for somebody; then "
        f"{settings['pack']['mistaken']:.0%} of the windows are about that"
    )


def _measured_by(made: Mapping[str, Any]) -> str:
    if "measured" not in made:
        return ""
    return f"; measured with commit {made['measured']}, on pictures as they are drawn there"


def _mix(mine: Mapping[str, float], usual: Mapping[str, float]) -> str:
    """How the streets to learn from differ from those to be measured on."""
    words = {
        "scooters": "cyclists are on e-scooters",
        "wheelchairs": "pedestrians use a wheelchair",
        "beside": "pedestrians stand close to somebody",
    }
    parts = [f"{mine[k]:.0%} of the {what} ({usual[k]:.0%})" for k, what in words.items()]
    things = (
        f"up to {mine['clutter']:g} more bollards, bins, signs and hydrants stand near the camera"
    )
    return f"{', '.join(parts)}, and {things}"


def meets_target(test: Mapping[str, Any]) -> bool:
    """Whether a test of the card has what was aimed at."""
    return bool(min(_recalls(test).values()) >= TARGET_RECALL and test[_FALSE] <= TARGET_FALSE)


def _verdict(test: Mapping[str, Any]) -> str:
    aim = f"Aimed at, through the configured camera: recall of at least {TARGET_RECALL:.0%} within "
    aim += f"15 m for pedestrians and cyclists, at most {TARGET_FALSE:g} false one a 100 frames."
    if meets_target(test):
        return f"{aim} **Reached.**"
    recalls = " and ".join(f"{recall:.1%}" for recall in _recalls(test).values())
    return f"{aim} **It falls short:** {recalls}, with {test[_FALSE]:.1f} false ones."


def _measured(title: str, test: Mapping[str, Any]) -> str:
    false = test[_FALSE]
    cars = test["kinds"]["vehicle"]["false_per_100_frames"]
    other = test["another_kind_pedestrian_or_cyclist_per_100_frames"]
    loose = test["loose_pedestrian_or_cyclist_per_100_frames"]
    said = f"{test['frames']} frames from seed {test['seed']}. A 100 frames have {false:g} false "
    said += f"pedestrians or cyclists, {cars:g} false vehicles, {other:g} pedestrians or cyclists "
    said += (
        f"that are road users of another kind, and {loose:g} that are boxed too loosely to count."
    )
    lines = [f"### {title}", "", said]
    for kind in Kind:
        numbers = test["kinds"][kind.label]
        lines += [
            "",
            f"**{kind.label}**",
            "",
            "| distance | objects | recall | median error | 90 % below |",
            "| --- | ---: | ---: | ---: | ---: |",
            _row("within 15 m", numbers["within_15_m"]),
            _row("of them, 65 % or more visible", numbers["within_15_m_mostly_visible"]),
            *(_row(f"{r['from_m']:g} to {r['to_m']:g} m", r) for r in numbers["rings"]),
        ]
    lines += [
        "",
        "**By light** (within 15 m; rain by itself)",
        "",
        "| light | frames | pedestrians | cyclists | false a 100 frames |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for light, row in test["lights"].items():
        recalls = " | ".join(_percent(row[k.label]) for k in (Kind.PEDESTRIAN, Kind.CYCLIST))
        lines.append(
            f"| {light} | {row['frames']} | {recalls} | {row['false_per_100_frames']:.1f} |"
        )
    return "\n".join(lines) + "\n"


def _in_float(file: str, test: Mapping[str, Any]) -> str:
    return (
        "### What rounding to eight bits costs\n\n"
        f"`{file}` on the same pictures as above, through the configured camera: {_near(test)}.\n"
    )


def _exactness(test: Mapping[str, Any]) -> str:
    spread = test["spread"]
    recalls = " and ".join(
        f"{spread[k.label][0]:.1%} to {spread[k.label][1]:.1%} of the {k.label}s"
        for k in _WALKS_AND_RIDES
    )
    low, high = spread[_FALSE]
    return (
        "### How exact that is\n\n"
        "Pictures of one street are alike. Of tests of as many other streets through the "
        f"configured camera, 95 in 100 would find {recalls} within 15 m, with {low:.2f} to "
        f"{high:.2f} false ones a 100 frames (bootstrap by street).\n"
    )


def _near(test: Mapping[str, Any]) -> str:
    found = " and ".join(f"{recall:.1%} of the {name}s" for name, recall in _recalls(test).items())
    false = f"{test[_FALSE]:g} false pedestrians or cyclists a 100 frames"
    return f"within 15 m {found}, with {false}"


def _recalls(test: Mapping[str, Any]) -> dict[str, float]:
    """Of pedestrians and of cyclists within 15 m."""
    return {k.label: test["kinds"][k.label]["within_15_m"]["recall"] for k in _WALKS_AND_RIDES}


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _row(ring: str, numbers: Mapping[str, Any]) -> str:
    def shown(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    return _ROUND.format(
        ring=ring,
        objects=numbers["objects"],
        recall=shown(numbers["recall"], "{:.1%}"),
        median=shown(numbers["median_error_m"], "{:.2f} m"),
        p90=shown(numbers["p90_error_m"], "{:.2f} m"),
    )


def _experiment(experiment: Mapping[str, Any]) -> str:
    """The paper's effect in miniature."""
    said = f"One network ({experiment['weights']:,} weights), from scratch, "
    said += f"{experiment['steps']} steps each on "
    said += f"{experiment['pictures']} rectilinear drawings, and on those drawings warped by "
    said += "`bikeped model augment`; both measured on held-out drawn fisheye pictures "
    said += f"(`scripts/train-detector --experiment`, commit {experiment['commit']})."
    lines = [
        "## Trained on ordinary pictures, and on the same pictures made fisheye",
        "",
        said,
        "",
        "| road users | trained on ordinary | on augmented | factor |",
        "| --- | ---: | ---: | ---: |",
    ]
    pairs = [(experiment[name]["road_users"]) for name in ("ordinary", "augmented")]
    rows = [("all", pairs[0]["all"], pairs[1]["all"])]
    rows += [(a["name"], a, b) for a, b in zip(pairs[0]["rows"], pairs[1]["rows"], strict=True)]
    for name, a, b in rows:
        for measure, key in (("AP@50:95", "ap"), ("AP@50", "ap50")):
            old, new = a[key], b[key]
            factor = "-" if not old or new is None else f"{new / old:.2f}"
            lines.append(f"| {name}, {measure} | {_three(old)} | {_three(new)} | {factor} |")
    lines += [
        "",
        "The box of a warped object is that of its old box's warped outline, a little wider than",
        "the exact ones that are asked for: AP@50:95 counts that, AP@50 hardly does.",
    ]
    if max(row["ap"] or 0.0 for row in rows[0][1:]) < _UNTRAINED_AP:
        lines += [
            "",
            "Neither has learnt much in so few steps: this says little about a longer training.",
        ]
    return "\n".join(lines) + "\n"


def _three(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
