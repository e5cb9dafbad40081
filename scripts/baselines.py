"""The baselines of definitions, section 14, on own scenarios, random encounters and real traffic.

The paper's rule as it was at `COMMIT`, raw and as that commit's lamp showed it, the same rule with
today's tracker, window and hold, and the light that knows danger. All get the same detections; the
old code runs in a process of its own, from a copy of that commit's files.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped import __version__
from bikeped.config.load import load_config
from bikeped.decision.shown import AS_RAW, ShownSettings
from bikeped.files import write_whole
from bikeped.lab.scenarios.random_encounters import random_encounters
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.light_record import light_figures
from bikeped.lab.simulation.suite import CONFIGURATIONS
from bikeped.lab.traffic.readers import read_traffic
from bikeped.lab.traffic.suite import Noise, TrafficSuite

ROOT = Path(__file__).parents[1]
COMMIT = "eafeb8a"
#: That commit's lamp: every frame of ALERT, held for a second.
OLD_LAMP = ShownSettings(on_frames=1, hold_s=1.0)
SEED, ENCOUNTERS = 0, 200
DELAY_FRAMES = 6
#: Noise and delay by the name of the condition.
SCRIPTED: dict[str, tuple[Noise, int]] = {
    "ideal": ("located", 0),
    "loss": ("realistic", 0),
    "latency 200 ms": ("located", DELAY_FRAMES),
    "loss and latency": ("realistic", DELAY_FRAMES),
}
RECORDED: dict[str, tuple[Noise, int]] = {"realistic": ("realistic", 0), "bursts": ("bursts", 0)}

#: Run in the folder of the old files: detections in, raw states out.
_OLD_CODE = """
import sys
import numpy as np
from bikeped.config import DecisionConfig, TrackingConfig
from bikeped.config.build import rule_settings, tracker_settings
from bikeped.conformance.simulate import Scene, rows_of, states, track
given = np.load(sys.argv[1])
tracker, rule = tracker_settings(TrackingConfig()), rule_settings(DecisionConfig())
names = ("xy_m", "detected", "kind", "delay_frames")
scenes = [Scene(*(given[f"{name}{i}"] for name in names)) for i in range(int(given["count"]))]
raw = [states(rows_of(track([scene], tracker)), rule) for scene in scenes]
np.save(sys.argv[2], np.concatenate(raw))
"""


def old_states(suite: TrafficSuite, code: Path) -> npt.NDArray[np.int8]:
    """Raw state codes of all frames from the tracker and the rule in the folder `code`."""
    given: dict[str, Any] = {"count": len(suite.detections)}
    for i, sequence in enumerate(suite.detections):
        given |= {f"{name}{i}": value for name, value in vars(sequence).items()}
    with tempfile.TemporaryDirectory() as folder:
        detections, found = Path(folder, "detections.npz"), Path(folder, "states.npy")
        np.savez(detections, **given)
        command = [sys.executable, "-c", _OLD_CODE, str(detections), str(found)]
        subprocess.run(command, check=True, cwd=code)  # its `bikeped` comes first
        return np.asarray(np.load(found), np.int8)


def rows(suite: TrafficSuite, code: Path) -> dict[str, Any]:
    """The figures of every baseline."""
    selected = CONFIGURATIONS["selected"]
    old = old_states(suite, code)
    lights = {
        "selected, raw, then": suite.records(old, AS_RAW),
        "selected, lamp, then": suite.records(old, OLD_LAMP),
        "selected": suite.lights(selected),
        "foresight": suite.foresight(selected),
    }
    return {name: light_figures(found) for name, found in lights.items()}


def material(
    suite: TrafficSuite, conditions: Mapping[str, tuple[Noise, int]], code: Path
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for condition, (noise, delay_frames) in conditions.items():
        found[condition] = rows(suite.with_noise(noise, SEED, delay_frames), code)
        for name, figures in found[condition].items():
            keys = ("alerts_per_hour", "red_share", "alerts_with_danger", "sensitivity")
            text = ", ".join(f"{key} {figures[key]:.3g}" for key in (*keys, "specificity"))
            sys.stdout.write(f"  {condition}, {name}: {text}\n")
    return {"scenes": len(suite.scenes), "conditions": found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--traffic", type=Path, default=ROOT.parent / "shared" / "traffic")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "baselines.json")
    options = parser.parse_args()
    loaded = load_config(ROOT / "config.yaml")
    sources = {
        "own": TrafficSuite.of_scenarios(load_scenarios(bundled_folder()), loaded, "none", SEED),
        "encounters": TrafficSuite.of_scenarios(
            random_encounters(SEED, ENCOUNTERS), loaded, "none", SEED
        ),
    }
    if options.traffic.is_dir():
        scenes = read_traffic(options.traffic)
        sources["traffic"] = TrafficSuite.load(scenes, loaded, "none", SEED)
    archive = subprocess.run(
        ["git", "-C", str(ROOT), "archive", COMMIT, "bikeped"], check=True, capture_output=True
    )
    materials = {}
    with tempfile.TemporaryDirectory() as code:
        with tarfile.open(fileobj=BytesIO(archive.stdout)) as files:
            files.extractall(code, filter="data")
        for name, suite in sources.items():
            sys.stdout.write(f"{name}\n")
            conditions = RECORDED if name == "traffic" else SCRIPTED
            materials[name] = material(suite, conditions, Path(code))
    data = {
        "command": "scripts/baselines",
        "version": __version__,
        "then": COMMIT,
        "config_hash": loaded.hash,
        "seed": SEED,
        "materials": materials,
    }
    write_whole(options.out, json.dumps(data, indent=1) + "\n")
    sys.stdout.write(f"wrote {options.out}\n")


if __name__ == "__main__":
    main()
