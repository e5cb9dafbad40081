"""Trains the bundled small detector: draws streets, trains, tests, writes the card.

    scripts/train-detector --out DIR              all steps, an hour and a quarter on two cores
    scripts/train-detector --out DIR --ship       and copies the model into the package, its
                                                  card into docs/
    scripts/train-detector --out DIR --experiment rectilinear against fisheye-augmented training
    scripts/train-detector --measure              tests the package's model again, on pictures as
                                                  they are drawn now, and writes its card
    scripts/train-detector --card                 writes the card's text from its figures

A step whose result is in DIR already is skipped; remove it to do it again.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec

from bikeped import __version__
from bikeped.config.build import road_region
from bikeped.config.load import LoadedConfig, load_config
from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector, sha256_of
from bikeped.files import make_folder, write_whole
from bikeped.lab.rendering.dataset import DEFAULT_MIX
from bikeped.lab.training.augment import AugmentSettings, augment_data
from bikeped.lab.training.coco import read_coco
from bikeped.lab.training.crops import CropSettings
from bikeped.lab.training.drawn import DrawnSettings, draw_training_set
from bikeped.lab.training.export import (
    CALIBRATION_IMAGES,
    calibration_images,
    export_network,
    quantise,
)
from bikeped.lab.training.fit import FitSettings, fit
from bikeped.lab.training.hard_negative_mining import MINING_ROUNDS, MiningSettings
from bikeped.lab.training.model_card import (
    DrawnTest,
    bootstrap_spread,
    choose_confidence,
    drawn_test,
    render_card,
    summary,
    summary_by_light,
    sweep,
)
from bikeped.lab.training.network import (
    SmallDetector,
    SmallNet,
    load_weights,
    multiply_adds,
    shift_scores,
)
from bikeped.lab.training.packing import PackSettings
from bikeped.lab.training.small import SmallTrainSettings, supports_bfloat16, train_small
from bikeped.lab.training.warp import WarpRanges
from bikeped.models import BUNDLED_FILE
from bikeped.types import Kind

#: The model card, which `--ship`, `--measure` and `--card` write.
CARD = Path(__file__).parents[1] / "docs" / "bundled-detector.md"
#: The steps take less than an hour on two cores that multiply bfloat16 themselves.
PICTURES, STEPS = 5000, 11200
#: Width and height of the shipped network's input for a whole frame: 30 frames a second on two
#: cores. It trains on pictures 1280 across, scaled around this.
SHOWN = (1152, 672)
CROPS = CropSettings(scale=(0.8, 1.02))
MINING = MiningSettings(after=MINING_ROUNDS)
TRAINING = DrawnSettings(pictures=PICTURES, seed=1)
#: So many that the four pictures of one street do not decide the number of false positives.
VALIDATION = (
    DrawnTest(pictures=2400, seed=8_000_001),
    DrawnTest(pictures=1200, seed=9_000_001),
    DrawnTest(pictures=1200, seed=9_800_001),
)
TEST = DrawnTest(pictures=2400, seed=9_200_001)
OTHER_LENSES = replace(TEST, pictures=300, seed=9_500_001, own_lens=True)
#: The shipped confidence of a kind is the lowest with at most this many false positives per 100
#: frames on the validation pictures: of pedestrians and cyclists together a little less than the
#: target, divided so that both reach the target recall.
MOST_FALSE = {Kind.PEDESTRIAN: 0.75, Kind.CYCLIST: 0.2, Kind.VEHICLE: 3.0}
GRID = [round(0.02 * i, 2) for i in range(2, 48)]

#: Of the experiment, equal for both networks; half the batch, for more steps in the same time.
EXPERIMENT_PICTURES, EXPERIMENT_STEPS = 500, 2500


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for everything")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--pictures", type=int, default=PICTURES)
    parser.add_argument(
        "--ship", action="store_true", help="copy the model into the package, its card into docs/"
    )
    parser.add_argument("--experiment", action="store_true")
    parser.add_argument("--measure", action="store_true", help="measure the package's model again")
    parser.add_argument("--card", action="store_true", help="write the card from its figures")
    options = parser.parse_args()
    if options.measure or options.card:
        write_card(measure=options.measure)
        return 0
    if options.out is None:
        parser.error("--out: name the folder for everything")
    out: Path = options.out
    make_folder(out)
    if options.experiment:
        experiment(out)
        return 0
    build(out, options.pictures, options.steps)
    if options.ship:
        names = ("small.onnx", "small-int8.onnx", "small.json")
        for target in (*map(BUNDLED_FILE.with_name, names), CARD):
            shutil.copyfile(out / target.name, target)
            say(f"wrote {target}")
    return 0


def build(out: Path, pictures: int, steps: int) -> None:
    """All steps up to the card."""
    loaded = load_config(None)
    data = out / "data"
    if not (data / "annotations.json").is_file():
        began = time.monotonic()
        draw_training_set(
            data, replace(TRAINING, pictures=pictures), loaded, counted("drawn", pictures)
        )
        drawing = {"seconds": round(time.monotonic() - began, 1), "mix": asdict(TRAINING.mix)}
        write_json(out / "drawing.json", drawing)
    training = out / "training"
    if not (training / "training.json").is_file():
        make_folder(training)
        order = SmallTrainSettings(steps=steps, device="cpu", crops=CROPS, mining=MINING)
        write_json(
            training / "training.json", train_small(read_coco(data), training, order, say=say)
        )
    detector = replace(load_weights(training / "weights.pt"), size=SHOWN)
    network, names = detector.network, detector.names
    # Thresholds are chosen for the eight-bit network, the most used one.
    whole = read_coco(data)
    export_network(detector, out / "plain.onnx")
    quantise(out / "plain.onnx", calibration_images(whole, SHOWN), out / "plain-int8.onnx")
    plain = DetectionConfig(model=str((out / "plain-int8.onnx").resolve()), confidence=0.04)
    validation = []
    for test in VALIDATION:
        (seen,), _ = drawn_test([plain], loaded, test, counted("validated", test.pictures))
        validation += seen
    chosen = [choose_confidence(validation, kind, GRID, MOST_FALSE[kind]) for kind in Kind]
    shipped = loaded.config.detection.confidence
    shift_scores(network, chosen, shipped)
    exported = export_network(detector, out / "small.onnx")
    int8 = out / "small-int8.onnx"
    int8_bytes = quantise(out / "small.onnx", calibration_images(whole, SHOWN), int8)
    model = shipped_as(loaded, int8)
    road = load_detector(model, Path("/"), road_region(loaded)).input_size
    card: dict[str, Any] = {
        "model": {
            "file": "small.onnx",
            "sha256": sha256_of(out / "small.onnx"),
            "bytes": exported.bytes,
            "int8_file": "small-int8.onnx",
            "int8_sha256": sha256_of(int8),
            "int8_bytes": int8_bytes,
            "int8_pictures": CALIBRATION_IMAGES,
            "classes": list(names),
            "input": list(SHOWN),
            "weights": sum(p.numel() for p in network.parameters()),
            "multiply_adds": multiply_adds(network, *SHOWN),
            "road_input": list(road),
            "road_multiply_adds": multiply_adds(network, *road),
            "score_shift": {"from": chosen, "to": shipped},
        },
        "made": {
            "command": "scripts/train-detector --out DIR --ship",
            "bikeped": __version__,
            "commit": commit(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            "seed_data": TRAINING.seed,
            "configured_share": TRAINING.configured,
            "usual_mix": asdict(DEFAULT_MIX),
            "validation_pictures": sum(test.pictures for test in VALIDATION),
            "most_false": {kind.label: most for kind, most in MOST_FALSE.items()},
            "drawing": read(out / "drawing.json"),
            "training": within(out, read(training / "training.json")),
        },
        "validation": sweep(validation, [g for g in GRID if g >= plain.confidence]),
    }
    card |= measured(out, loaded)
    if (out / "experiment.json").is_file():
        card["experiment"] = read(out / "experiment.json")
    write_json(out / "small.json", card)
    write_whole(out / CARD.name, render_card(card))
    say(f"wrote {out / 'small.onnx'}, small-int8.onnx, small.json, {CARD.name}")


def measured(folder: Path, loaded: LoadedConfig) -> dict[str, Any]:
    """The card's tests of `folder`'s small.onnx and small-int8.onnx."""
    shipped = loaded.config.detection.confidence
    sections: dict[str, Any] = {}
    for name, test, files in (
        ("configured_camera", TEST, {"": "small-int8.onnx", "_float": "small.onnx"}),
        ("other_lenses", OTHER_LENSES, {"": "small-int8.onnx"}),
    ):
        models = [shipped_as(loaded, folder / file) for file in files.values()]
        said = counted(f"tested, {name}", test.pictures)
        found, lights = drawn_test(models, loaded, test, said)
        for end, seen in zip(files, found, strict=True):
            numbers = summary(seen, shipped)
            sections[name + end] = {
                "seed": test.seed,
                **numbers,
                "spread": bootstrap_spread(seen, shipped),
                "lights": summary_by_light(seen, lights, shipped),
            }
    return sections


def write_card(measure: bool) -> None:
    """Writes the card of the package's model, its figures measured again or as they are."""
    folder = BUNDLED_FILE.parent
    card = read(folder / "small.json")
    if measure:
        card |= measured(folder, load_config(None))
        card["made"]["measured"] = commit()
        write_json(folder / "small.json", card)
    write_whole(CARD, render_card(card))
    say(f"wrote {folder / 'small.json'}, {CARD}")


def shipped_as(loaded: LoadedConfig, model: Path) -> DetectionConfig:
    """The default detection configuration, with this model."""
    return msgspec.structs.replace(loaded.config.detection, model=str(model.resolve()))


def experiment(out: Path) -> None:
    """The same network, steps and seeds on ordinary pictures and on fisheye-augmented ones."""
    loaded = load_config(None)
    folder = out / "experiment"
    make_folder(folder)
    ordinary = DrawnSettings(
        EXPERIMENT_PICTURES, seed=21, configured=0, large=0, lens="rectilinear"
    )
    held_out = DrawnSettings(400, seed=22, configured=0, large=0)
    for name, settings in (("ordinary", ordinary), ("held-out", held_out)):
        if not (folder / name / "annotations.json").is_file():
            draw_training_set(folder / name, settings, loaded, counted(name, settings.pictures))
    if not (folder / "augmented" / "annotations.json").is_file():
        # As wide as the held-out pictures: objects keep their size.
        order = AugmentSettings(WarpRanges(size_px=960), 0, 1, 0.3, 2)
        source = read_coco(folder / "ordinary")
        augment_data(source, folder / "augmented", order, counted("augmented", len(source.images)))
    lines: dict[str, Any] = {
        "commit": commit(),
        "pictures": EXPERIMENT_PICTURES,
        "steps": EXPERIMENT_STEPS,
        "weights": sum(p.numel() for p in SmallNet(len(Kind)).parameters()),
    }
    for name, view in (("ordinary", (960, 544)), ("augmented", (960, 960))):
        model = folder / f"{name}.onnx"
        if not model.is_file():
            order_of_fit = FitSettings(
                steps=EXPERIMENT_STEPS,
                warmup=60,
                pictures=4,
                crops=CropSettings(view=view, scale=(0.85, 1.4)),
                pack=PackSettings(squares=8),
                bfloat16=supports_bfloat16("cpu"),
            )
            fitted = fit(read_coco(folder / name), order_of_fit, say=say)
            detector = SmallDetector(fitted.network, fitted.names, (960, 544), {"experiment": name})
            export_network(detector, model)
            write_json(folder / f"{name}.json", {"seconds": round(fitted.seconds, 1)})
        lines[name] = read(folder / f"{name}.json")
    report = folder / "evaluation.json"
    models = [f"{name}={folder / name}.onnx" for name in ("ordinary", "augmented")]
    command = [sys.executable, "-m", "bikeped.cli.main", "model", "evaluate", *models]
    subprocess.run([*command, str(folder / "held-out"), "--json", str(report)], check=True)
    for row in read(report)["models"]:
        lines[row["label"]]["road_users"] = row["road_users"]
        lines[row["label"]]["merged"] = row["merged"]
    write_json(out / "experiment.json", lines)
    say(f"wrote {out / 'experiment.json'}")


def say(line: str) -> None:
    print(line, flush=True)


def counted(what: str, total: int) -> Any:
    """Prints progress every 20 s."""
    began, last = time.monotonic(), [0.0]

    def progress(done: int) -> None:
        now = time.monotonic()
        if now - last[0] > 20 or done == total:
            last[0] = now
            say(f"{what}: {done} of {total}, {now - began:.0f} s")

    return progress


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def within(folder: Path, facts: dict[str, Any]) -> dict[str, Any]:
    """`facts` with paths relative to `folder`."""
    here = f"{folder}/"
    return {k: v.removeprefix(here) if isinstance(v, str) else v for k, v in facts.items()}


def write_json(path: Path, data: Any) -> None:
    write_whole(path, json.dumps(data, indent=1) + "\n")


def commit() -> str:
    """The sources' commit, with a plus for uncommitted changes."""
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return run.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
