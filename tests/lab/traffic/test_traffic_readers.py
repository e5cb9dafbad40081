"""Traffic files: CSV, packed or not, and SUMO's XML are one; bad input is one line."""

import gzip
import json

import numpy as np
import pytest
from traffic_scenes import BUNDLED, POLE, csv_text, write_traffic, xml_text

from bikeped.errors import ScenarioError
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.traffic.readers import read_scene, read_traffic

HEADER = "time_s,id,kind,x_m,y_m\n"
WALK = "0,1,pedestrian,0,0\n1,1,pedestrian,1,0\n"


def test_a_folder_gives_its_scenes_and_poles(tmp_path):
    scenes = read_traffic(write_traffic(tmp_path))
    assert [s.scenario.name for s in scenes] == ["safe-crossing", "swerving-cyclist"]
    assert all(s.pose == CameraPose(5, -13, 90) for s in scenes)


@pytest.mark.parametrize("name", ["Swerving Cyclist", "Occluded Emergence", "Safe Crossing"])
def test_csv_and_sumo_are_the_scenario(tmp_path, name):
    scenario = BUNDLED[name]
    files = {"a.csv": csv_text(scenario).encode(), "b.xml": xml_text(scenario).encode()}
    files |= {f"{file}.gz": gzip.compress(data) for file, data in files.items()}
    for file, data in files.items():
        (tmp_path / file).write_bytes(data)
        read = read_scene(tmp_path / file)
        assert read.name == file[0]
        found = {(a.kind, tuple(map(tuple, a.path.tolist()))) for a in read.agents}
        assert found == {(a.kind, tuple(map(tuple, a.path.tolist()))) for a in scenario.agents}


def test_rows_in_any_order_and_columns_in_any_order(tmp_path):
    (tmp_path / "a.csv").write_text(HEADER + WALK)
    turned = "id,y_m,x_m,kind,time_s\n1,0,1,pedestrian,1\n\n1,0,0,pedestrian,0\n"
    (tmp_path / "b.csv").write_text(turned)
    a, b = (read_scene(tmp_path / name).agents[0].path for name in ("a.csv", "b.csv"))
    np.testing.assert_array_equal(a, b)


def test_a_recording_begins_with_its_first_moment(tmp_path):
    """As of SUMO with --begin, here from a spreadsheet, whose text begins with a mark."""
    late = "\ufeff" + HEADER + "25200,1,pedestrian,0,0\n25201,1,pedestrian,1,0\n"
    (tmp_path / "a.csv").write_text(late, encoding="utf-8")
    assert read_scene(tmp_path / "a.csv").agents[0].path.tolist() == [[0, 0, 0], [1, 1, 0]]


def test_a_heading_is_not_the_noise_of_one_who_stands(tmp_path):
    """Rides north, then stands for 5 s while the recording jitters by a centimetre."""
    t = np.arange(100) / 10
    ride = np.minimum(t, 5) * 3
    jitter = np.random.default_rng(0).choice([-0.01, 0, 0.01], (100, 2))
    rows = [
        f"{a:.1f},1,cyclist,{dx:.2f},{y + dy:.2f}"
        for a, y, (dx, dy) in zip(t, ride, jitter, strict=True)
    ]
    (tmp_path / "a.csv").write_text(HEADER + "\n".join(rows))
    _, heading, _ = read_scene(tmp_path / "a.csv").agents[0].sample(t)
    assert np.abs(np.degrees(heading) - 90).max() < 5


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.csv", "", "line 1: expected the columns"),
        ("a.csv", "time,id,kind,x,y\n", "line 1: expected the columns"),
        ("a.csv", HEADER, "holds nobody"),
        ("a.csv", HEADER + "0,1,pedestrian,0\n", "line 2: expected 5 values, found 4"),
        ("a.csv", HEADER + "0,1,dog,0,0\n", "line 2: kind: 'dog'"),
        ("a.csv", HEADER + WALK + "x,1,pedestrian,0,0\n", "line 4: time_s: 'x'"),
        ("a.csv", HEADER + WALK + "2,1,pedestrian,nan,0\n", "line 4: x_m: 'nan'"),
        ("a.csv", HEADER + WALK + "2,1,pedestrian,0,1e9\n", "line 4: y_m: '1e9'"),
        ("a.csv", HEADER + WALK + "-1,1,pedestrian,0,0\n", "line 4: time_s: '-1'"),
        ("a.csv", HEADER + WALK + "1,1,pedestrian,2,0\n", "id 1: is in two places at 1 s"),
        ("a.csv", HEADER + WALK + "2,1,cyclist,2,0\n", "id 1: is pedestrian and cyclist"),
        ("a.csv", HEADER + WALK + "9e5,2,pedestrian,2,0\n9.9e5,2,pedestrian,2,0\n3e5,3,car,0,0\n"
         "4e5,3,car,0,0\n", "are too much at once"),
        ("a.csv", b"\xff\xfe", "is not UTF-8"),
        ("a.csv.gz", b"no gzip", "cannot be read"),
        ("a.csv.gz", gzip.compress(b"time_s" * 99, mtime=0)[:-9], "cannot be read"),
        ("a.xml", "<fcd-export>", "is not XML"),
        ("a.xml", "<routes/>", "<routes>: expected <fcd-export>"),
        ("a.xml", '<fcd-export><timestep time="0"><person x="0" y="0"/></timestep></fcd-export>',
         "time 0 s: <person>: id is missing"),
        ("a.xml", '<fcd-export><timestep time="0"><person id="p" x="0"/></timestep></fcd-export>',
         "time 0 s: <person>: y: 'None'"),
    ],
)  # fmt: skip
def test_a_bad_scene_is_one_line(tmp_path, name, content, says):
    data = content if isinstance(content, bytes) else content.encode()
    (tmp_path / name).write_bytes(data)
    (tmp_path / "poles.json").write_text(json.dumps({"a": POLE}))
    with pytest.raises(ScenarioError) as error:
        read_traffic(tmp_path)
    assert str(error.value).startswith(str(tmp_path / name))
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot be read"),
        ("{", "is not JSON"),
        ("[]", "expected"),
        ("{}", "a: is missing"),
        ('{"a": {"x_m": 0, "y_m": 0}}', "a: expected the keys x_m, y_m, heading_deg"),
        ('{"a": {"x_m": 0, "y_m": 0, "heading_deg": "north"}}', "a: heading_deg: 'north'"),
    ],
)
def test_bad_poles_are_one_line(tmp_path, content, says):
    (tmp_path / "a.csv").write_text(HEADER + WALK)
    if content is not None:
        (tmp_path / "poles.json").write_text(content)
    with pytest.raises(ScenarioError) as error:
        read_traffic(tmp_path)
    assert str(error.value).startswith(str(tmp_path / "poles.json"))
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_no_folder_and_no_scene(tmp_path):
    with pytest.raises(ScenarioError, match="is not a folder"):
        read_traffic(tmp_path / "none")
    with pytest.raises(ScenarioError, match="holds no SCENE"):
        read_traffic(tmp_path)
