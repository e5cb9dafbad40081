"""Faults of configuration, calibration and model files: rows 29, 37 to 40, 48."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np

from bikeped.config.load import load_config
from bikeped.errors import BikepedError
from campaign.registry import row
from campaign.rig import ROOT, Rig


def _refused(path: Path, *overrides: str) -> str:
    """The message that refuses a configuration; empty where it is accepted."""
    from bikeped.config.build import framing, ground_camera

    try:
        loaded = load_config(path, overrides)
        framing(loaded)
        ground_camera(loaded)
    except BikepedError as error:
        return str(error)
    return ""


@row(
    29,
    "power cut in a write of the configuration: cut off at every byte",
    "refused, or the same light and camera; last good copy",
    "another light or camera = 0",
    in_tests=True,
)
def cut_off(rig: Rig) -> None:
    """A prefix that runs must drive what the whole file drives."""
    light = "feedback: {light: usb, usb: {device: relay, relay_red: 2, relay_green: 1}}\n"
    whole = (rig.config("web: {enabled: false}\n" + light + "complete: true\n")).read_text()
    wanted = load_config(rig.folder / "pole.yaml", ()).config
    cut, wrong, accepted = rig.folder / "cut.yaml", 0, 0
    for size in range(len(whole) - len("complete: true\n")):
        cut.write_text(whole[:size])
        try:
            config = load_config(cut, ()).config
        except BikepedError:
            continue
        accepted += 1
        wrong += config.feedback != wanted.feedback or config.camera != wanted.camera
    rig.measure("another light or camera", wrong)
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
    shutil.copy(ROOT / "config.yaml", rig.folder / "config.yaml")
    file = rig.folder / "camera_calibration.json"
    whole = json.loads((ROOT / "camera_calibration.json").read_text())
    file.write_text(json.dumps(whole))
    path = rig.folder / "config.yaml"
    rig.expect(not _refused(path, "camera.calibration=camera_calibration.json"), "not even whole")
    refused, names = 0, []
    mutants = list(_mutants(whole))
    for name, mutant in mutants:
        file.write_text(json.dumps(mutant))
        message = _refused(
            path, "camera.calibration=camera_calibration.json", "camera.radius_px=null"
        )
        refused += bool(message)
        if not message:
            names.append(name)
    rig.measure("mutants refused", 100 * refused / len(mutants))
    if names:
        rig.saw(f"accepted: {', '.join(names)}")


def _mutants(whole: dict[str, object]):  # type: ignore[no-untyped-def]
    """(name, calibration) of files that no lens of this camera has."""
    numbers = {
        "fx": (0.001, -500.0, float("nan"), 1e6), "fy": (0.001, float("nan")),
        "cx": (float("nan"), -4000.0, 1e5), "cy": (float("inf"), 1e5),
        "k1": (5.0, float("nan")), "k2": (-9.0,), "k3": (9.0,), "k4": (-9.0,),
        "rms": (-1.0, float("nan")), "width": (10, -5), "height": (0, 1e9),
    }  # fmt: skip

    def walk(value: object, path: tuple[object, ...] = ()):  # type: ignore[no-untyped-def]
        items = value.items() if isinstance(value, dict) else ()
        for key, inner in items:
            yield from walk(inner, (*path, key))
        if isinstance(value, (int, float)) and not isinstance(value, bool) and path:
            yield path

    for path in walk(whole):
        for number in numbers.get(str(path[-1]), ()):
            mutant = json.loads(json.dumps(whole))
            at = mutant
            for key in path[:-1]:
                at = at[key]
            at[path[-1]] = number
            yield f"{'.'.join(map(str, path))} {number}", mutant


@row(
    39,
    "one byte of the model or of its weights' own file changed",
    "the hash refuses it",
    "loaded = 0",
    in_tests=True,
)
def changed_model(rig: Rig) -> None:
    from bikeped.detection.detector import load_detector, sha256_of
    from bikeped.models import model_file

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
    bundled = bytearray(model_file("bundled", rig.folder).read_bytes())
    rig.saw(f"bundled model of {len(bundled)} bytes: see the detector's own tests for its hash")
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
                         "detection.model=external.onnx"))  # fmt: skip
    try:
        load_detector(config.config.detection, rig.folder)
    except BikepedError:
        return 0
    rig.expect(False, "weights in a file of their own may change under the same hash")
    return 1


@row(
    40,
    "a malicious .pt as the model, in run, check and export",
    "refused",
    "payload runs = 0",
    in_tests=True,
)
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
