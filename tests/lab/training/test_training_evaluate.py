"""Evaluation from pictures to figures: a network whose answers are known, and a real one."""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from coco_sets import CATEGORIES, annotation, edit, write_set
from shared_inputs import CLIP, MODEL, missing

from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import Detector
from bikeped.detection.model_metadata import ModelMetadata
from bikeped.errors import DataSetError, DetectorError
from bikeped.lab.rendering.dataset import write_dataset
from bikeped.lab.simulation.perception import AREA_SCALE
from bikeped.lab.training.coco import read_coco
from bikeped.lab.training.evaluate import EvaluationSettings, ModelUnderTest, evaluate, load_models
from bikeped.lab.training.evaluation_report import draw_evaluation, evaluation_rows
from bikeped.lab.training.measures import INPUT_PX

CPU = DetectionConfig(providers=("cpu",), threads=1)
ONE = EvaluationSettings(least_objects=1)
NAMES = ("person", "bicycle", "car", "kite")
RIDER, BIKE = [110, 40, 30, 90], [90, 90, 70, 60]  # x, y, width, height
WALKER, CAR = [240, 60, 30, 90], [10, 150, 70, 40]
EVERYBODY = [(RIDER, 1), (BIKE, 2), (WALKER, 1), (CAR, 3)]


class Told:
    """A network that answers what it is told: rows of class, box (x, y, w, h), score a picture."""

    description = "told"
    region = None
    metadata = ModelMetadata(names=NAMES, end_to_end=True)

    def __init__(self, *pictures):
        self.buffer = np.zeros((1, 3, 320, 320), np.float32)
        self._queue = [[], [], *pictures]  # the detector looks twice before the first picture

    def run(self):
        rows = np.zeros((1, 20, 6), np.float32)
        for i, (number, (x, y, wide, high), score) in enumerate(self._queue.pop(0)):
            rows[0, i] = [x, y + 40, x + wide, y + high + 40, score, number]  # 320 x 240, centred
        return [("output0", rows)]


def model(*pictures, label="told", config=CPU):
    detector = Detector(Path("told.onnx"), config, "0" * 64, Told(*pictures))
    return ModelUnderTest(label, Path("told.onnx"), detector)


def data(tmp_path, *pictures, size=(320, 240)):
    """Pictures with boxes of COCO's categories 1 person, 2 bicycle, 3 car."""
    things = [
        annotation(100 * image + k, image, category, box)
        for image, boxes in enumerate(pictures, 1)
        for k, (box, category) in enumerate(boxes)
    ]
    return read_coco(write_set(tmp_path / "set", things, images=len(pictures), size=size))


def rows(measures):
    return {row.name: row for row in measures.rows}


def test_a_rider_is_two_by_class_and_one_as_deployed(tmp_path):
    seen = [(0, RIDER, 0.9), (1, BIKE, 0.8), (0, WALKER, 0.7), (2, CAR, 0.6), (3, CAR, 0.5)]
    done = []
    result = evaluate(data(tmp_path, EVERYBODY), [model(seen)], CPU, ONE, done.append)
    (score,) = result.scores
    assert done == [1]
    assert {n: r.objects for n, r in rows(score.classes).items()} == {
        "person": 2,
        "bicycle": 1,
        "car": 1,
    }
    assert {n: r.objects for n, r in rows(score.merged).items()} == {
        "pedestrian": 2,
        "cyclist": 1,
        "vehicle": 1,
    }
    assert {n: r.objects for n, r in rows(score.road_users).items()} == {
        "pedestrian": 1,
        "cyclist": 1,
        "vehicle": 1,
    }
    for part in (score.classes, score.merged, score.road_users):
        assert part.overall.ap == pytest.approx(1)
        assert part.overall.ar == pytest.approx(1)


def test_the_joined_cyclist_holds_rider_and_cycle(tmp_path):
    """A detector that answers the cycle alone finds a bicycle, but half a cyclist."""
    result = evaluate(data(tmp_path, [(RIDER, 1), (BIKE, 2)]), [model([(1, BIKE, 0.8)])], CPU, ONE)
    (score,) = result.scores
    assert rows(score.merged)["cyclist"].ap == pytest.approx(1)
    # The union is 70 x 110, the cycle 70 x 60: IoU 0.545, enough for 0.50 alone.
    assert rows(score.road_users)["cyclist"].ar == pytest.approx(0.1)
    assert rows(score.road_users)["pedestrian"].objects == 0


def test_without_joining_riders_stay_people(tmp_path):
    apart = msgspec.structs.replace(CPU, rider_overlap=1.0)
    seen = [(0, RIDER, 0.9), (1, BIKE, 0.8)]
    result = evaluate(
        data(tmp_path, [(RIDER, 1), (BIKE, 2)]), [model(seen, config=apart)], apart, ONE
    )
    users = rows(result.scores[0].road_users)
    assert (users["pedestrian"].objects, users["cyclist"].objects) == (1, 1)
    assert users["pedestrian"].ap == pytest.approx(1)


def test_whole_cyclists_in_the_data_are_left_whole(tmp_path):
    """Data of pedestrian, cyclist and vehicle, as drawn scenes have them."""
    whole = [90, 40, 70, 110]
    source = data(tmp_path, [(RIDER, 1), (whole, 2), (CAR, 3)])
    names = ("pedestrian", "cyclist", "vehicle")
    edit(source.source, categories=[{"id": n, "name": name} for n, name in enumerate(names, 1)])
    result = evaluate(read_coco(source.source), [model([(2, CAR, 0.9)])], CPU, EvaluationSettings())
    (score,) = result.scores
    assert score.classes is None  # the network knows other names
    assert [row.objects for row in score.road_users.rows] == [1, 1, 1]
    assert rows(score.merged)["vehicle"].ap == pytest.approx(1)
    assert result.data["categories_not_known_to_every_model"] == list(names)


def test_deployed_confidence_is_for_what_is_deployed(tmp_path):
    seen = [(0, WALKER, 0.05), (2, CAR, 0.5)]
    (score,) = evaluate(data(tmp_path, [(WALKER, 1), (CAR, 3)]), [model(seen)], CPU, ONE).scores
    assert rows(score.classes)["person"].ar == pytest.approx(1)
    assert rows(score.merged)["pedestrian"].ar == pytest.approx(1)
    assert rows(score.road_users)["pedestrian"].ar == 0
    assert score.curve.recall == (0.5,)  # of both, which are of one size


def test_two_classes_of_one_kind_are_one_object_when_merged(tmp_path):
    seen = [(1, BIKE, 0.9), (1, [91, 90, 70, 60], 0.8)]
    (score,) = evaluate(data(tmp_path, [(BIKE, 2)]), [model(seen)], CPU, ONE).scores
    assert rows(score.merged)["cyclist"].ap == pytest.approx(1)


def test_areas_are_those_of_a_network_input_of_1280(tmp_path):
    assert (INPUT_PX / 3840) ** 2 == AREA_SCALE
    for size, box, area in (
        ((320, 240), [100, 100, 10, 10], 1600),
        ((240, 320), [100, 100, 10, 10], 1600),
        ((1280, 720), [100, 100, 10, 10], 100),
        ((2560, 1440), [100, 100, 10, 10], 25),
    ):
        folder = tmp_path / f"{size[0]}"
        folder.mkdir()
        (score,) = evaluate(data(folder, [(box, 1)], size=size), [model([])], CPU, ONE).scores
        assert score.curve.area_px2 == (pytest.approx(area),)
        sizes = rows(score.road_users)["pedestrian"].objects_by_size
        assert sizes == ((1, 0, 0) if area < 1024 else (0, 1, 0))


def test_several_models_and_the_json_and_figure_of_them(tmp_path):
    source = data(tmp_path, EVERYBODY, EVERYBODY)
    full = [(0, RIDER, 0.9), (1, BIKE, 0.8), (0, WALKER, 0.7), (2, CAR, 0.6)]
    models = [model(full[:1], [], label="original"), model(full, full, label="fisheye $2$")]
    result = evaluate(source, models, CPU, ONE)
    told = result.as_dict()
    assert [m["label"] for m in told["models"]] == ["original", "fisheye $2$"]
    assert told["models"][1]["road_users"]["all"]["ap"] == pytest.approx(1)
    assert told["models"][0]["road_users"]["all"]["ap"] < 0.4
    curve = told["models"][1]["recall_curve"]
    assert set(curve) == {"all", "pedestrian", "cyclist", "vehicle"}
    assert sum(curve["all"]["objects"]) == 6
    assert told["data"]["images"] == 2
    names = [name for name, _ in evaluation_rows(result.scores[0])]
    assert names[0] == "all classes (3)"
    paths = draw_evaluation(result, tmp_path / "figure.png")
    assert [path.name for path in paths] == ["figure.png", "figure.pdf"]
    drawn = cv2.imread(str(paths[0]))
    assert drawn.shape[1] > 1000
    colours = {tuple(c) for c in drawn.reshape(-1, 3)[::7]}
    assert {(0xB2, 0x72, 0x00), (0x00, 0x5E, 0xD5)} <= colours  # both models' bars, BGR


def test_data_without_road_users_are_refused(tmp_path):
    source = data(tmp_path, [(CAR, 3)])
    no_cars = msgspec.structs.replace(CPU, vehicle=("tram",))
    with pytest.raises(DataSetError, match="holds no pedestrian, cyclist or vehicle"):
        evaluate(source, [model([])], no_cars, ONE)


def test_models_are_told_apart(tmp_path):
    with pytest.raises(DataSetError, match="two are called 'a'"):
        load_models([("a", tmp_path / "1.onnx"), ("a", tmp_path / "2.onnx")], CPU)
    with pytest.raises(DetectorError, match="1\\.onnx"):
        load_models([("a", tmp_path / "1.onnx")], CPU)


def test_drawn_scenes_are_read_and_judged_by_distance(tmp_path):
    """Data of `bikeped.lab.rendering`: the truth finds everything, near and far."""
    data = read_coco(write_dataset(tmp_path / "scenes", 4, 1, size=(480, 270)))
    assert list(data.categories.values()) == ["pedestrian", "cyclist", "vehicle"]
    scale, top = 320 / 480, (320 - 180) // 2
    answers = []
    for image in data.images:
        boxes = [(t.category_id - 1, np.multiply(t.box_px, scale)) for t in data.objects[image.id]]
        answers.append(
            [(c, [b[0], b[1] + top - 40, b[2] - b[0], b[3] - b[1]], 0.9) for c, b in boxes]
        )
    network = Told(*answers)
    network.metadata = ModelMetadata(
        names=("pedestrian", "cyclist", "vehicle"), end_to_end=True, ultralytics=True
    )
    detector = Detector(Path("told.onnx"), CPU, "0" * 64, network)
    result = evaluate(data, [ModelUnderTest("told", Path("told.onnx"), detector)], CPU, ONE)
    (score,) = result.scores
    assert score.classes.overall.ar > 0.9  # boxes of a few pixels are rounded
    known = [t for found in data.objects.values() for t in found if not t.crowd]
    bins = [one for of_kind in score.by_distance.values() for one in of_kind]
    assert sum(one["objects"] for one in bins) == len(known) > 5
    assert sum(score.road_users.false) == 0


@pytest.mark.skipif(bool(missing(MODEL, CLIP)), reason=missing(MODEL, CLIP))
def test_a_real_network_over_real_pictures(tmp_path):
    """YOLOX nano over two frames with boxes marked by hand: a car; a car and a cyclist."""
    folder = tmp_path / "clip"
    folder.mkdir()
    marked = {
        20: [([35, 113, 178, 156], 3)],
        390: [([0, 53, 162, 108], 3), ([667, 21, 30, 66], 1), ([633, 57, 79, 46], 2)],
    }
    images, things = [], []
    clip = cv2.VideoCapture(str(CLIP))
    for number in range(max(marked) + 1):
        assert clip.grab()
        if number in marked:
            name = f"{number}.png"
            cv2.imwrite(str(folder / name), clip.retrieve()[1])
            images.append({"id": number, "file_name": name, "width": 768, "height": 432})
            for box, category in marked[number]:
                things.append(annotation(len(things) + 1, number, category, box))
    clip.release()
    (folder / "annotations.json").write_text("{}")
    edit(folder / "annotations.json", images=images, annotations=things, categories=CATEGORIES)
    result = evaluate(read_coco(folder), load_models([("nano", MODEL)], CPU), CPU, ONE)
    (score,) = result.scores
    # What is measured as deployed is what the deployed call answers.
    (nano,) = load_models([("nano", MODEL)], CPU)
    frame = cv2.cvtColor(cv2.imread(str(folder / "390.png")), cv2.COLOR_BGR2RGB)
    deployed = nano.detector.infer(frame, 768, 432).detections
    users, every = nano.detector.infer_classes(frame, 768, 432, 0.001)
    assert len(every) > len(users) > 0
    for part in ("kind", "confidence", "box_px"):
        assert np.array_equal(getattr(users, part), getattr(deployed, part))
    assert (score.facts["classes_in_model"], score.facts["input_px"]) == (80, [416, 416])
    car = rows(score.classes)["car"]
    assert (car.objects, car.ap50) == (2, pytest.approx(1))
    assert car.ap > 0.6  # hand and network agree to a few pixels
    assert rows(score.merged)["vehicle"].ap == pytest.approx(car.ap)
    assert [row.objects for row in score.merged.rows] == [1, 1, 2]
    assert [row.objects for row in score.road_users.rows] == [0, 1, 2]  # the rider is no pedestrian
    assert score.curve.objects == (1, 1, 1)
    assert score.curve.area_px2[0] == pytest.approx(79 * 82 * (1280 / 768) ** 2)
