"""Event files and the audit log: whole files, rotation, full disks, and coming back from them."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from bikeped.config.output_sections import AuditConfig
from bikeped.errors import TelemetryError
from bikeped.telemetry.builders import event_line, rfc3339
from bikeped.telemetry.event_files import AuditLog, EventWriter
from bikeped.telemetry.schema import EventHeader, EventLine
from bikeped.types import Decision, Detections, State, Tracks

DEADLINE_S = 30.0
HEADER = EventHeader(
    format="bikeped-events/1",
    config_hash="c",
    calibration_hash=None,
    model_hash=None,
    version="1",
    started_at=rfc3339(0.0),
)


def line(number: int) -> EventLine:
    return event_line(
        t_s=number / 30,
        frame=number,
        decision=Decision(0.0, State.IDLE, "Nobody is near."),
        tracks=Tracks.empty(0.0),
        detections=Detections.empty(),
        latency_ms={},
    )


def frames(path: Path) -> list[int | str]:
    """Frame numbers of a file's lines; `header` for a header."""
    lines = [json.loads(text) for text in path.read_text().splitlines()]
    return [text.get("frame", "header") for text in lines]


def wait(condition) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail("the audit thread did not get there")
        time.sleep(0.002)  # another thread's progress, which has no event for outsiders


def test_an_event_file_appears_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "events.jsonl"
    path.write_text("an older file")
    with EventWriter(path, HEADER) as events:
        events.write(line(0))
        assert path.read_text() == "an older file"
        assert events.partial_path.name == "events.jsonl.partial"
        events.write(line(1))
    assert frames(path) == ["header", 0, 1]
    assert [item.name for item in tmp_path.iterdir()] == ["events.jsonl"]
    events.close()  # again is harmless


def test_an_interrupted_event_file_stays_under_its_partial_name(tmp_path: Path):
    path = tmp_path / "events.jsonl"

    def interrupted() -> None:
        with EventWriter(path, HEADER) as events:
            events.write(line(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not path.exists()
    assert frames(tmp_path / "events.jsonl.partial") == ["header", 0]


def test_an_event_file_that_cannot_be_written_is_said_in_words(tmp_path: Path):
    with pytest.raises(TelemetryError, match=r"absent.*--events"):
        EventWriter(tmp_path / "absent" / "events.jsonl", HEADER)


def test_a_full_disk_under_an_event_file_is_said_in_words(tmp_path: Path):
    (tmp_path / "events.jsonl.partial").symlink_to("/dev/full")
    events = EventWriter(tmp_path / "events.jsonl", HEADER)

    def write_more_than_any_buffer_holds() -> None:
        for number in range(10_000):
            events.write(line(number))

    with pytest.raises(TelemetryError, match=r"No space left.*--events"):
        write_more_than_any_buffer_holds()
    with pytest.raises(TelemetryError, match="No space left"):
        events.abandon()


def audit(path: Path, header: EventHeader = HEADER, **options) -> AuditLog:
    keys = {
        name: options.pop(name) for name in ("max_mb", "keep", "min_free_mb") if name in options
    }
    config = AuditConfig(path=str(path), **{"min_free_mb": 0.0, **keys})
    log = AuditLog(config, header, **{"retry_s": 0.01, **options})
    log.start()
    return log


def test_lines_are_appended_and_every_run_begins_with_its_header(tmp_path: Path):
    path = tmp_path / "made" / "audit.jsonl"
    for run in range(2):
        log = audit(path)
        for number in range(3):
            log.write(line(10 * run + number))
        assert log.close(DEADLINE_S)
        assert (log.written, log.dropped, log.fault) == (3, 0, None)
    assert frames(path) == ["header", 0, 1, 2, "header", 10, 11, 12]


def test_rotation_keeps_so_many_files_and_loses_nothing_younger(tmp_path: Path):
    path = tmp_path / "audit.jsonl"
    log = audit(path, max_mb=0.01, keep=2)
    for number in range(400):
        log.write(line(number))
    assert log.close(DEADLINE_S)
    names = sorted(item.name for item in tmp_path.iterdir())
    assert names == ["audit.jsonl", "audit.jsonl.1", "audit.jsonl.2"]
    seen: list[int | str] = []
    for name in reversed(names):
        content = frames(tmp_path / name)
        assert content[0] == "header"
        assert "header" not in content[1:]
        assert (tmp_path / name).stat().st_size <= 10_000
        seen += content[1:]
    assert seen == list(range(int(seen[0]), 400))
    assert log.written == 400
    assert len(seen) < 400  # older files are gone


def test_no_path_means_no_log_and_no_thread():
    log = AuditLog(AuditConfig(path=None), HEADER)
    log.start()
    log.write(line(0))
    assert log.close()
    assert (log.written, log.dropped, log.fault) == (0, 0, None)


def test_the_queue_drops_its_oldest_and_counts_while_the_disk_hangs(tmp_path: Path):
    hanging, release = threading.Event(), threading.Event()

    def free(_directory: Path) -> int:
        hanging.set()
        release.wait(DEADLINE_S)
        return 10**12

    path = tmp_path / "audit.jsonl"
    log = audit(path, queue_size=5, free_bytes=free)
    log.write(line(0))
    assert hanging.wait(DEADLINE_S)  # the thread holds line 0 and hangs in the disk
    for number in range(1, 101):
        log.write(line(number))
    assert log.dropped == 95
    assert not log.close(timeout_s=0.0)  # bounded: the disk still hangs
    release.set()
    assert log.close(DEADLINE_S)
    assert frames(path) == ["header", 0, 96, 97, 98, 99, 100]
    assert log.written + log.dropped == 101


def test_too_little_room_is_a_fault_until_there_is_room_again(tmp_path: Path, caplog):
    room = {"bytes": 499_000_000}
    path = tmp_path / "audit.jsonl"
    with caplog.at_level(logging.INFO):
        log = audit(path, min_free_mb=500.0, free_bytes=lambda _: room["bytes"])
        log.write(line(0))
        wait(lambda: log.fault is not None)
        assert "audit.min_free_mb" in str(log.fault)
        assert not path.exists()
        log.write(line(1))
        room["bytes"] = 500_000_000
        wait(lambda: log.fault is None)
        assert log.close(DEADLINE_S)
    assert frames(path) == ["header", 0, 1]
    assert log.dropped == 0
    assert [record.levelname for record in caplog.records] == ["ERROR", "INFO"]  # once a change


def test_a_full_disk_is_a_fault_and_lines_not_written_are_counted(tmp_path: Path):
    (tmp_path / "audit.jsonl").symlink_to("/dev/full")
    log = audit(tmp_path / "audit.jsonl")
    log.write(line(0))
    wait(lambda: log.fault is not None)
    assert "No space left" in str(log.fault)
    assert log.close(DEADLINE_S)
    assert (log.written, log.dropped) == (0, 1)


def test_a_path_that_cannot_be_made_is_a_fault_until_it_can(tmp_path: Path):
    blocker = tmp_path / "log"
    blocker.write_text("a file where a directory should be")
    log = audit(blocker / "audit.jsonl")
    log.write(line(0))
    wait(lambda: log.fault is not None)
    assert "audit.path" in str(log.fault)
    blocker.unlink()
    wait(lambda: log.fault is None)
    assert log.close(DEADLINE_S)
    assert frames(blocker / "audit.jsonl") == ["header", 0]


def test_a_line_that_a_full_disk_tore_is_taken_back():
    """A real partial write: a file size limit cuts in the middle of a line."""
    program = """
import resource, signal, sys, tempfile, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_telemetry_files import DEADLINE_S, audit, frames, line, wait
path = Path(tempfile.mkdtemp()) / "audit.jsonl"
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
log = audit(path)
for number in range(20):
    log.write(line(number))
wait(lambda: log.fault is not None)
torn = frames(path)
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
wait(lambda: log.fault is None)
assert log.close(DEADLINE_S)
whole = [frame for frame in frames(path) if frame != "header"]
assert torn[0] == "header" and 1 < len(torn) < 20, torn
assert whole == list(range(20)), whole
assert log.dropped == 0
"""
    subprocess.run(
        [sys.executable, "-c", program, str(Path(__file__).parent)], check=True, timeout=60
    )


@pytest.mark.parametrize("tail", ['{"t":1.0,"fra', '{"t":1.0,' + 2084 * "\0", "\0" * 9000])
@pytest.mark.parametrize("whole", [[], [3]])
def test_a_power_cut_costs_only_what_follows_the_last_whole_line(tmp_path, whole, tail, caplog):
    path = tmp_path / "audit.jsonl"
    path.write_text("".join(f'{{"frame":{n}}}\n' for n in whole) + tail)
    log = audit(path)
    log.write(line(5))
    assert log.close(DEADLINE_S)
    rest = path.read_text().splitlines()
    assert [json.loads(text).get("frame") for text in rest] == [*whole, None, 5]
    assert "cut 13 bytes of a torn last line" in caplog.text or "\0" in tail


def test_a_file_that_was_moved_away_is_begun_anew(tmp_path: Path):
    path = tmp_path / "audit.jsonl"
    log = audit(path)
    log.write(line(0))
    wait(lambda: log.written == 1)
    path.rename(tmp_path / "taken")
    log.write(line(1))
    assert log.close(DEADLINE_S)
    assert frames(tmp_path / "taken") == ["header", 0]
    assert frames(path) == ["header", 1]


def test_a_bug_in_the_thread_shows_as_a_fault(tmp_path: Path):
    def free(_directory: Path) -> int:
        raise RuntimeError("a bug")

    log = audit(tmp_path / "audit.jsonl", free_bytes=free)
    log.write(line(0))
    wait(lambda: log.fault is not None)
    assert "a bug" in str(log.fault)
    assert log.close(DEADLINE_S)


def test_numbers_of_a_frame_survive_the_file(tmp_path: Path):
    tracks = Tracks(
        0.0,
        np.array([1]),
        np.array([1], np.int8),
        np.array([[1.2344, -5.6]]),
        np.zeros((1, 2)),
        np.zeros(1),
        np.zeros(1, np.int64),
    )
    with EventWriter(tmp_path / "e.jsonl", HEADER) as events:
        events.write(
            event_line(
                t_s=0.0,
                frame=0,
                decision=Decision(0.0, State.SAFE, "s"),
                tracks=tracks,
                detections=Detections.empty(),
                latency_ms={},
            )
        )
    last = json.loads((tmp_path / "e.jsonl").read_text().splitlines()[-1])
    assert (last["tracks"][0]["x"], last["tracks"][0]["y"]) == (1.234, -5.6)
