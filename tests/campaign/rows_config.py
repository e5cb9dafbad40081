"""Faults of configuration, calibration and model files: rows 29, 37 to 40, 48."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import io
import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bikeped.cli.main import main
from bikeped.config.load import load_config
from bikeped.errors import BikepedError
from campaign.registry import row
from campaign.rig import ROOT, Rig


def _refused(path: Path, *overrides: str) -> str:
    """The message with which `bikeped config check` refuses; empty where it accepts."""
    options = [part for override in overrides for part in ("--set", override)]
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(said):
        status = main(["config", "check", "-c", str(path), *options])
    return said.getvalue() if status or "refuses it" in said.getvalue() else ""


@row(
    29,
    "power cut in a write of the configuration: cut off at every byte",
    "refused where the last good copy is whole",
    "run other than the whole = 0",
)
def cut_off(rig: Rig) -> None:
    """A prefix that runs must drive what the whole file drives."""
    light = "feedback: {light: usb, usb: {device: relay, relay_red: 2, relay_green: 1}}\n"
    whole = rig.config("web: {enabled: false}\n" + light).read_text()
    good = load_config(rig.folder / "pole.yaml", ())
    load = functools.partial(load_config, overrides=())
    if importlib.util.find_spec("bikeped.config.last_good"):
        runnable = importlib.import_module("bikeped.config.last_good").load_runnable
        load = functools.partial(runnable, last_good=good)
    cut, wrong, accepted = rig.folder / "cut.yaml", 0, 0
    for size in range(len(whole) - len("complete: true\n")):
        cut.write_text(whole[:size])
        try:
            config = load(cut).config
        except BikepedError:
            continue
        accepted += 1
        wrong += config != good.config
    rig.measure("run other than the whole", wrong)
    rig.saw(f"{accepted} of {len(whole)} prefixes accepted, {wrong} of them other than the whole")


@row(
    37,
    "malformed, unknown and out-of-range configuration; a FIFO",
    "refused, the field is named",
    "accepted = 0; longest check <= 2 s",
)
def bad_configuration(rig: Rig) -> None:
    config = rig.config()
    accepted = 0
    for override in (
        "decision.memory_frames=0", "detection.confidence=1", "camera.stale_after_s=60",
        "camera.height_m=-1", "camera.height_m=.nan", "camera.fps=.inf", "decision.d_min_m=30",
        "tracking.max_unseen_s=-1", "feedback.blink_hz=0", "nosuch.key=1", "camera.nosuch=1",
        "camera.width=ninety", "web.port=99999", "mqtt.qos=3", "detection.layout=other",
    ):  # fmt: skip
        message, key = _refused(config, override), override.partition("=")[0]
        accepted += not message
        rig.expect(bool(message), f"{override} is accepted")
        named = key.rpartition(".")[2] in message or key.partition(".")[0] in message
        rig.expect(not message or named, f"{override}: the message does not name the field")
    rig.measure("accepted", accepted)
    fifo = rig.folder / "fifo.yaml"
    os.mkfifo(fifo)
    for path, text in ((fifo, None), (rig.folder / "bad.yaml", "a: [1\n"), (config, None)):
        if text:
            path.write_text(text)
        began = os.times().elapsed
        try:
            rig.bikeped("config", "check", "-c", path, timeout_s=20)
        except subprocess.TimeoutExpired:
            rig.expect(False, f"{path.name} hangs the check")
        rig.measure("longest check", os.times().elapsed - began)


@row(
    38,
    "calibration with NaN, wrong size, swapped axes, senseless terms",
    "refused",
    "mutants refused >= 100 %",
    in_tests=True,
)
def bad_calibration(rig: Rig) -> None:
    file, path = rig.folder / "camera_calibration.json", rig.folder / "config.yaml"
    path.write_text((ROOT / "config.yaml").read_text())
    whole = json.loads((ROOT / "camera_calibration.json").read_text())
    lens = (f"camera.calibration={file}", "camera.radius_px=null", "camera.fov_deg=null")
    file.write_text(json.dumps(whole))
    rig.expect(not _refused(path, *lens), f"the whole file is refused: {_refused(path, *lens)}")
    accepted, mutants = [], list(_mutants(whole))
    for name, mutant in mutants:
        file.write_text(json.dumps(mutant))
        if not _refused(path, *lens):
            accepted.append(name)
    rig.measure("mutants refused", 100 - 100 * len(accepted) / len(mutants))
    rig.saw(f"{len(mutants)} mutants" + (f"; accepted: {', '.join(accepted)}" if accepted else ""))


def _mutants(whole: dict[str, object]) -> Iterator[tuple[str, dict[str, object]]]:
    """(name, calibration) of files that no lens of this camera has.

    Their checksum is left out, as in a file that a person wrote; with it each is refused anyway.
    """
    nan, inf = float("nan"), float("inf")
    plain = {key: value for key, value in whole.items() if key != "checksum"}
    for key, numbers in {
        "focal_length": (0.001, -500.0, nan, inf, 1e6, 20.0),
        "cx": (nan, -4000.0, 1e5),
        "cy": (inf, 1e5, -1.0),
        "k1": (5.0, nan, -5.0),
        "k2": (-9.0, 9.0),
        "fov_deg": (nan, -10.0, 1e4),
        "rms_error_px": (-1.0, nan, 500.0),
        "frame_width": (10, -5),
        "frame_height": (0, 1_000_000_000),
        "model": ("none-such", None),
    }.items():
        for number in numbers:
            yield f"{key} {number}", {**plain, key: number}
    yield "cx and cy swapped", {**whole, "cx": whole["cy"], "cy": whole["cx"]}
    yield "frame turned", {
        **plain, "frame_width": whole["frame_height"], "frame_height": whole["frame_width"]
    }  # fmt: skip


@row(
    39,
    "one byte of the model or of its weights' own file changed",
    "the hash refuses it",
    "loaded = 0",
)
def changed_model(rig: Rig) -> None:
    from bikeped.detection.detector import load_detector, sha256_of

    config = rig.config()
    hashes = {"pinned": sha256_of(rig.model)}
    data = bytearray(rig.model.read_bytes())
    data[len(data) // 2] ^= 1
    rig.model.write_bytes(data)
    loaded = 0
    try:
        settings = load_config(config, (f"detection.sha256={hashes['pinned']}",)).config.detection
        load_detector(settings, rig.folder)
        loaded += 1
        rig.expect(False, "a pinned model is loaded though it has changed")
    except BikepedError:
        pass
    loaded += _external_weights_changed(rig)
    rig.measure("loaded", loaded)


def _external_weights_changed(rig: Rig) -> int:
    """1 where a model is loaded whose weights, in a file of their own, are not those hashed."""
    import onnx
    from small_crossing import write_model

    from bikeped.detection.detector import load_detector, sha256_of

    model = onnx.load(write_model(rig.folder / "whole.onnx"))
    path = rig.folder / "external.onnx"
    onnx.save(
        model, path, save_as_external_data=True, location="external.onnx.data", size_threshold=0
    )
    pinned = sha256_of(path)
    weights = rig.folder / "external.onnx.data"
    values = np.frombuffer(weights.read_bytes(), np.float32).copy()
    values[values == np.float32(0.9)] = 0.8
    weights.write_bytes(values.tobytes())
    config = load_config(rig.config(name="external.yaml"), (f"detection.sha256={pinned}",
                         f"detection.model={path}"))  # fmt: skip
    try:
        load_detector(config.config.detection, rig.folder)
    except BikepedError as error:
        rig.saw(str(error))
        return 0
    rig.expect(False, "weights in a file of their own may change under the same hash")
    return 1


@row(40, "a malicious .pt as the model, in run, check and export", "refused", "payload runs = 0")
def malicious_model(rig: Rig) -> None:
    import pickle

    mark = rig.folder / "payload-ran"

    class Payload:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.system, (f"touch {mark}",)

    evil = rig.folder / "evil.pt"
    evil.write_bytes(pickle.dumps(Payload()))
    config = rig.config()
    service = rig.start(config, f"detection.model={evil}")
    rig.expect(service.wait() == 2, "run does not refuse it")
    rig.bikeped("config", "check", "-c", config, "--set", f"detection.model={evil}")
    export = rig.bikeped("export", evil)
    rig.expect(export.returncode != 0, "export does not refuse it")
    rig.measure("payload runs", float(mark.exists()))


@row(
    48,
    "stale_after_s and silent_after_s of 60 s",
    "refused: at most 2 s",
    "accepted = 0",
    in_tests=True,
)
def long_limits(rig: Rig) -> None:
    config, accepted = rig.config(), 0
    for key in ("camera.stale_after_s", "detection.silent_after_s"):
        for value in ("60", "2.5", "10"):
            message = _refused(config, f"{key}={value}")
            accepted += not message
            rig.expect(bool(message), f"{key} {value} is accepted")
    rig.measure("accepted", accepted)
