"""`bikeped conformance encounters`: files that every command reads, the same for the same seed."""

from bikeped.cli.main import main
from bikeped.lab.scenarios.scenario import load_scenarios


def encounters(out, seed, count):
    arguments = ["--seed", str(seed), "--count", str(count), "--out", str(out)]
    return main(["conformance", "encounters", *arguments])


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_same_seed_same_bytes(tmp_path):
    assert encounters(tmp_path / "a", 7, 5) == 0
    assert encounters(tmp_path / "b", 7, 4) == 0
    assert encounters(tmp_path / "c", 8, 4) == 0
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert len(load_scenarios(tmp_path / "a")) == len(a) == 5
    assert b.items() <= a.items()  # a shorter list is the beginning of a longer one
    assert not set(b.values()) & set(c.values())


def test_a_folder_with_files_is_refused(tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("name: Mine")
    assert encounters(tmp_path, 0, 1) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "--out" in said
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]
