"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from bikeped.errors import BikepedError
from bikeped.files import WholeFile, make_folder, whole_folder, write_like, write_whole


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_the_old_file_stays_until_the_new_one_is_whole(tmp_path: Path):
    path = tmp_path / "clip.avi"
    path.write_text("old")
    with WholeFile(path) as partial:
        assert partial.parent == tmp_path
        assert partial.suffix == ".avi"
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert mode(path) == 0o644
    assert names(tmp_path) == ["clip.avi"]


def test_an_exception_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "clip.avi"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError), WholeFile(path) as partial:
        partial.write_text("half \udc80", encoding="utf-8")
    assert path.read_text() == "old"
    assert names(tmp_path) == ["clip.avi"]


def test_a_name_that_is_a_folder_is_refused_and_leaves_nothing(tmp_path: Path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(BikepedError, match=r"taken: cannot be written \(.*; choose a folder"):
        write_whole(tmp_path / "taken", "text")
    assert names(tmp_path) == ["taken"]
    with pytest.raises(BikepedError, match=r"nowhere/a: cannot be written"):
        write_whole(tmp_path / "nowhere" / "a", b"")


def test_text_is_written_as_utf8_and_a_pipe_stays_a_pipe(tmp_path: Path):
    write_whole(tmp_path / "text", "±")
    assert (tmp_path / "text").read_bytes() == b"\xc2\xb1"
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    write_whole(pipe, "±")
    reader.join()
    assert read == [b"\xc2\xb1"]
    assert pipe.is_fifo()


def test_a_file_like_another_has_its_mode_and_is_on_the_disk(tmp_path: Path, monkeypatch):
    like, path = tmp_path / "config.yaml", tmp_path / "config.yaml.bak"
    like.write_text("a: 1")
    like.chmod(0o600)
    flushed = []
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: flushed.append(real(handle)))
    owners = []
    monkeypatch.setattr(os, "chown", lambda name, user, group: owners.append((user, group)))
    write_like(path, b"a: 2", like)
    assert path.read_bytes() == b"a: 2"
    assert mode(path) == 0o600
    assert len(flushed) == 1
    assert owners == [(like.stat().st_uid, like.stat().st_gid)]


def test_a_folder_appears_whole_over_an_empty_one_only(tmp_path: Path):
    out = tmp_path / "out"
    make_folder(out)
    with whole_folder(out) as partial:
        (partial / "a").write_text("a")
        assert not list(out.iterdir())
    assert (out / "a").read_text() == "a"
    assert mode(out) == 0o755
    with pytest.raises(OSError, match="not empty"), whole_folder(out) as partial:
        (partial / "b").write_text("b")
    with pytest.raises(ValueError, match="stop"), whole_folder(tmp_path / "new"):
        raise ValueError("stop")
    assert names(tmp_path) == ["out"]
    assert names(out) == ["a"]
    with pytest.raises(BikepedError, match=r"a: cannot be made \(.*; choose another --report"):
        make_folder(out / "a", "--report")
