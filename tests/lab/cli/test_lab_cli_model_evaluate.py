"""`bikeped model evaluate` on the command line, with a real network file that knows one box."""

from __future__ import annotations

import json

import numpy as np
import onnx
import pytest
from coco_sets import annotation, write_set
from onnx import TensorProto, helper, numpy_helper

from bikeped.cli.main import main
from bikeped.lab.simulation.perception import load_recall_curve

CPU = ("--set", "detection.providers=[cpu]")


def network(path, rows):
    """An ONNX file that answers `rows` [n, 6] (x1, y1, x2, y2, score, class) to every picture."""
    table = np.zeros((1, 20, 6), np.float32)
    table[0, : len(rows)] = rows
    answer = numpy_helper.from_array(table, "answer")
    zero = numpy_helper.from_array(np.zeros(1, np.float32), "zero")
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["answer", "nothing"], ["output0"]),
    ]
    graph = helper.make_graph(
        nodes,
        "told",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 320, 320])],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, [1, 20, 6])],
        [answer, zero],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    facts = {"names": "['person', 'bicycle', 'car']", "end2end": "True", "imgsz": "[320, 320]"}
    helper.set_model_props(model, facts)
    onnx.save(model, str(path))
    return str(path)


@pytest.fixture
def file(tmp_path):
    """Two pictures, each with a small person and a large car."""
    things = [
        annotation(10 * image + k, image, category, box)
        for image in (1, 2)
        for k, (category, box) in enumerate([(1, [40, 20, 10, 30]), (3, [100, 60, 150, 100])])
    ]
    return write_set(tmp_path / "set", things, images=2)


@pytest.fixture
def models(tmp_path):
    """One that knows the car alone, and one that knows both; the picture is centred: 40 lower."""
    car, person = [100, 100, 250, 200, 0.9, 2], [40, 60, 50, 90, 0.8, 0]
    return [
        network(tmp_path / "coco.onnx", [car]),
        network(tmp_path / "fisheye.onnx", [car, person]),
    ]


def test_two_models_side_by_side(file, models, tmp_path, capsys):
    told, curve, figure = (tmp_path / name for name in ("e.json", "curve.csv", "e.png"))
    outputs = ["--json", str(told), "--curve", str(curve), "--figure", str(figure)]
    words = [f"original={models[0]}", f"fisheye={models[1]}", str(file.parent)]
    assert main(["model", "evaluate", *words, *outputs, *CPU, "--least-objects", "1"]) == 0
    text = capsys.readouterr().out
    assert "original AP" in text
    assert "AP ratio" in text
    line = next(li for li in text.splitlines() if li.startswith("all classes (2)"))
    assert line.split()[3:] == ["4", "0.5", "0.5", "0.5", "1", "1", "1", "2"]
    data = json.loads(told.read_text())
    assert [m["classes"]["all"]["ap"] for m in data["models"]] == [
        pytest.approx(0.5),
        pytest.approx(1),
    ]
    centres, recall = load_recall_curve(curve)
    assert centres == (pytest.approx(10 * 30 * 16), pytest.approx(150 * 100 * 16))
    assert recall == (1, 1)
    assert figure.is_file()
    assert figure.with_suffix(".pdf").is_file()


def test_false_boxes_and_distances_are_told(file, models, capsys):
    body = json.loads(file.read_text())
    for number, thing in enumerate(body["annotations"]):
        thing["distance_m"] = 4.0 * number  # person 0, car 4; person 8, car 12
    body["annotations"].pop()
    file.write_text(json.dumps(body))
    assert main(["model", "evaluate", models[0], str(file), *CPU]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["coco", "0", "0", "50"] in lines  # the car of the second picture is one too many
    assert ["pedestrian", "5", "to", "10", "1", "0"] in lines
    assert ["vehicle", "0", "to", "5", "1", "1"] in lines


def test_the_simulation_runs_with_the_curve(file, models, tmp_path, capsys):
    curve = tmp_path / "curve.json"
    words = [models[0], str(file), "--curve", str(curve), "--curve-iou", "0.5"]
    assert main(["model", "evaluate", *words, *CPU, "--least-objects", "1"]) == 0
    assert load_recall_curve(curve)[1] == (0, 1)
    capsys.readouterr()
    run = ["conformance", "montecarlo", "--trials", "1", "--processes", "1", "--json", "-"]
    assert main([*run, "--recall-curve", str(curve)]) == 0
    assert json.loads(capsys.readouterr().out)["curve"]["recall"] == [0, 1]


def test_json_alone_on_standard_output(file, models, capsys):
    assert main(["model", "evaluate", models[0], str(file), "--json", "-", *CPU]) == 0
    assert json.loads(capsys.readouterr().out)["models"][0]["label"] == "coco"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{model}", "none"], "none: does not exist"),
        (["none.onnx", "{set}"], "none.onnx"),
        (["{set}/annotations.json", "{set}"], "neither .onnx nor .engine"),
        (["{model}"], "MODEL"),
        (["{model}", "{model}", "{set}"], "two are called 'coco'"),
        (["{model}", "{set}", "--figure", "e.jpg"], "e.jpg: is no .png"),
        (["{model}", "{set}", "--curve", "c.csv"], "too few road users"),
        (["{model}", "{set}", "--json", "{set}/annotations.json"], "would"),
        (["{model}", "{set}", "--json", "{set}/images/001.jpg"], "would"),
        (["{model}", "{set}", "--curve", "{model}"], "would"),
        (["a={model}", "{set}", "--curve", "{model}"], "would"),
        (["{model}", "{set}", "--curve", "e.pdf", "--figure", "e.png"], "e.pdf"),
        (["{model}", "{set}", "--set", "detection.person=[x]"], "detection"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    file, models, tmp_path, monkeypatch, capsys, words, message
):
    monkeypatch.chdir(tmp_path)
    before = file.read_bytes()
    given = [word.format(set=file.parent, model=models[0]) for word in words]
    assert main(["model", "evaluate", *given, *CPU]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("bikeped: ") == 1
    assert file.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["coco.onnx", "fisheye.onnx", "set"]
