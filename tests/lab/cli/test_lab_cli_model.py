"""`bikeped model train` and `export`, from the command line."""

from __future__ import annotations

import importlib.util
import json
import sys

import pytest
from coco_sets import annotation, write_set

from bikeped.cli.main import main

with_torch = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None,
    reason="torch is not installed: pip install 'bikeped[train]'",
)


@pytest.fixture
def data(tmp_path):
    notes = [annotation(n, n, 1 + n % 3, [60, 80, 90, 70]) for n in range(1, 5)]
    return write_set(tmp_path / "set", notes, images=4)


def said(capsys):
    return capsys.readouterr().err.strip()


def test_help_names_the_four(capsys):
    assert main(["model", "--help"]) == 0
    page = capsys.readouterr().out
    assert all(word in page for word in ("augment", "train", "export", "evaluate"))


def test_without_torch_it_says_what_to_install(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    out = tmp_path / "out"
    assert main(["model", "train", str(data), "--out", str(out)]) == 2
    assert "pip install 'bikeped[train]'" in said(capsys)
    assert not out.exists()
    assert main(["model", "export", str(tmp_path / "weights.pt")]) == 2
    assert "pip install 'bikeped[train]'" in said(capsys)


def test_onnx_is_exported_to_an_engine_only(tmp_path, capsys):
    model = tmp_path / "model.onnx"
    model.write_bytes(b"nothing")
    assert main(["model", "export", str(model)]) == 2
    assert "--engine FILE.engine" in said(capsys)
    assert main(["model", "export", str(model), "--engine", str(tmp_path / "model.plan")]) == 2
    assert "end it with .engine" in said(capsys)
    assert main(["model", "export", str(model), "--engine", str(model)]) == 2
    assert "would be overwritten" in said(capsys)
    assert model.read_bytes() == b"nothing"


@with_torch
def test_the_small_network_from_data_to_model(data, tmp_path, capsys):
    out = tmp_path / "out"
    order = ["--network", "small", "--steps", "2", "--batch", "2", "--device", "cpu", "--mine"]
    assert main(["model", "train", str(data), "--out", str(out), *order, "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert json.loads((out / "training.json").read_text()) == summary
    assert summary["names"] == ["person", "bicycle", "car"]
    assert (summary["pictures"], summary["objects"], summary["size"]) == (4, 4, [1280, 736])
    assert summary["settings"]["steps"] == 2
    assert len(summary["mistakes"]) == 1  # two steps: both looks before the second
    assert (out / "model.onnx").stat().st_size == summary["model_bytes"] < 4e6

    again = tmp_path / "again.onnx"
    assert main(["model", "export", str(out / "weights.pt"), "--out", str(again)]) == 0
    assert "within" in capsys.readouterr().out
    assert again.read_bytes() == (out / "model.onnx").read_bytes()
    assert main(["model", "export", str(out / "weights.pt"), "--out", str(out / "m.pt")]) == 2
    assert "end it with .onnx" in said(capsys)

    small = tmp_path / "int8.onnx"
    order = ["model", "export", str(out / "weights.pt"), "--out", str(small), "--int8"]
    assert main([*order, str(data), "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["bytes"] == small.stat().st_size < again.stat().st_size / 2.5
    assert main([*order, str(tmp_path / "nothing")]) == 2
    assert "nothing" in said(capsys)


def test_only_what_was_trained_is_rounded(tmp_path, capsys):
    model = tmp_path / "model.onnx"
    model.write_bytes(b"nothing")
    assert main(["model", "export", str(model), "--int8", str(tmp_path)]) == 2
    assert "name weights.pt" in said(capsys)
    order = ["model", "export", str(tmp_path / "weights.pt"), "--int8", str(tmp_path)]
    assert main([*order, "--engine", str(tmp_path / "model.engine")]) == 2
    assert "leave out --engine" in said(capsys)


def test_options_of_the_other_network_are_refused_before_anything_is_made(data, tmp_path, capsys):
    out = tmp_path / "out"
    base = ["model", "train", str(data), "--out", str(out), "--network", "small"]
    assert main([*base, "--weights", str(tmp_path / "w.pt")]) == 2
    assert "--weights is for a YOLO" in said(capsys)
    assert main([*base, "--validation", str(data)]) == 2
    assert "--validation is for a YOLO" in said(capsys)
    assert main([*base[:-1], "yolov9-t", "--mine"]) == 2
    assert "--mine is for --network small" in said(capsys)
    assert not out.exists()


@with_torch
def test_an_unknown_device_is_refused(data, tmp_path, capsys):
    base = ["model", "train", str(data), "--out", str(tmp_path / "out"), "--network", "small"]
    assert main([*base, "--device", "moon"]) == 2
    assert "--device moon" in said(capsys)


@with_torch
def test_training_never_writes_over_its_data(data, tmp_path, capsys):
    folder = data.parent
    data.rename(folder / "training.json")
    base = ["model", "train", str(folder / "training.json"), "--out", str(folder)]
    assert main([*base, "--network", "small", "--steps", "1"]) == 2
    assert "DATA" in said(capsys)
    assert not (folder / "weights.pt").exists()
