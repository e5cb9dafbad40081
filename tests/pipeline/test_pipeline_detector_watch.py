"""Known answers go through the detector between frames; motion that it ignores is noticed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from pipeline_fakes import RGB, Rig, seen, small

from bikeped.cli.main import main
from bikeped.config.build import ground_camera, road_region
from bikeped.config.load import LoadedConfig, load_config
from bikeped.detection.detector import load_detector
from bikeped.errors import BikepedError, ConfigError
from bikeped.monitor.detector_check import CHECK_EVERY_S, SILENT_S, finds_again
from bikeped.pipeline.check_picture import (
    drawn_check_picture,
    known_answers,
    read_check_picture,
    write_check_picture,
)
from bikeped.pipeline.detector_watch import DetectorWatch
from bikeped.types import Detections, Kind

PERSON = seen((Kind.PEDESTRIAN, 40, 30))


@asynccontextmanager
async def watched(live: bool = True, config: LoadedConfig | None = None) -> AsyncIterator[Rig]:
    rig = Rig(live=live, config=config)
    camera = rig.track_and_decide.ground_mapper.camera
    rig.watch = DetectorWatch(rig.config, rig.detector, camera, live)
    try:
        async with rig:
            yield rig
    finally:
        await rig.watch.close()


async def until_blind(rig: Rig, limit_s: float) -> float:
    """Seconds of frames until the fault shows."""
    began_s = rig.clock.now_s
    while rig.clock.now_s < began_s + limit_s and rig.recorder.name != "FAULT":
        await rig.frames(1, 0.25)
    return rig.clock.now_s - began_s


def test_a_model_that_falls_silent_is_noticed_with_a_remembered_frame() -> None:
    async def scenario() -> None:
        async with watched() as rig:
            rig.detector.answer = PERSON
            await rig.frames(20, 0.25)
            assert rig.recorder.name == "SAFE"
            rig.detector.answer = Detections.empty()
            assert await until_blind(rig, 60.0) <= CHECK_EVERY_S + 10
            assert rig.recorder.signals[-1][0].faults[0].code == "detector.blind"
            assert rig.loop.counts.failed == rig.loop.counts.out_of_order == 0
            assert rig.loop.counts.frames == rig.loop.counts.received
            rig.detector.answer = PERSON
            for _ in range(30):
                await rig.frames(1, 0.25)
            assert rig.recorder.name == "SAFE"
            assert rig.watch is not None
            assert rig.watch.numbers.check_failures >= 2
            assert rig.watch.numbers.check_passes >= 1
            assert not rig.watch.verdict.active
            assert rig.loop.verdicts()[-1] == rig.watch.verdict

    asyncio.run(scenario())


def test_checks_pass_unnoticed_and_cost_no_frame() -> None:
    async def scenario() -> None:
        async with watched() as rig:
            rig.detector.answer = PERSON
            await rig.frames(400, 0.25)
            assert rig.watch is not None
            numbers = rig.watch.numbers
            assert numbers.check_passes >= 3
            assert numbers.check_failures == 0
            assert rig.loop.counts.frames == 400
            assert rig.detector.calls == 400 + numbers.check_passes
            assert "FAULT" not in {signal.name for signal, _, _ in rig.recorder.signals[40:]}

    asyncio.run(scenario())


def test_a_frame_that_comes_during_a_check_waits_for_it() -> None:
    async def scenario() -> None:
        async with watched() as rig:
            rig.detector.answer = PERSON
            calls = rig.detector.calls
            while rig.watch is not None and rig.watch.check_picture(-1.0) is None:
                await rig.frames(1, 0.25)
            await rig.frames(int(4 * CHECK_EVERY_S) - 8, 0.25)
            passes = rig.watch.numbers.check_passes if rig.watch else 0
            rig.detector.go.clear()  # whatever is detected next is held
            for _ in range(2):
                rig.clock.now_s += 8.0
                rig.feed.put(rig.clock.now_s)
            await asyncio.to_thread(rig.detector.entered.wait)
            rig.detector.go.set()
            await rig.recorder.until(lambda: rig.loop.counts.frames == rig.feed.number)
            await rig.frames(4, 0.25)
            assert rig.watch is not None
            assert rig.watch.numbers.check_passes > passes
            assert rig.detector.calls > calls

    asyncio.run(scenario())


def test_a_detector_that_raises_on_the_check_has_failed_it() -> None:
    async def scenario() -> None:
        async with watched() as rig:
            rig.detector.answer = PERSON
            await rig.frames(8, 0.25)
            answer, known = rig.detector.detect, rig.detector.answer

            def only_frames(picture):  # type: ignore[no-untyped-def]
                if picture.received_s == 0.0:  # the check's
                    raise RuntimeError("no memory")
                return answer(picture)

            rig.loop._detection.detect = only_frames
            assert len(known) == 1
            assert await until_blind(rig, 60.0) <= CHECK_EVERY_S + 10
            assert rig.loop.counts.failed == 0

    asyncio.run(scenario())


def test_a_recording_is_checked_at_the_same_frames_each_time() -> None:
    def run() -> list[tuple[int, str]]:
        async def scenario() -> list[tuple[int, str]]:
            async with watched(live=False) as rig:
                rig.max_inflight = 2
                rig.detector.answer = PERSON
                answer, count = rig.detector.detect, 0

                def silent_later(picture):  # type: ignore[no-untyped-def]
                    nonlocal count
                    count += 1
                    late = picture.frame.captured_s >= 5.0 or picture.received_s == 0.0
                    rig.detector.answer = Detections.empty() if late else PERSON
                    return answer(picture)

                rig.loop._detection.detect = silent_later
                for number in range(200):
                    rig.feed.put(number * 0.25)
                rig.feed.queue.put_nowait(None)
                await rig.ended()
                return [
                    (result.decoded.frame.number, result.signal.name)
                    for result in rig.recorder.results
                ]

        return asyncio.run(scenario())

    first = run()
    assert run() == first
    names = [name for _, name in first]
    assert "FAULT" not in names[10 : int(4 * CHECK_EVERY_S)]
    assert names[-1] == "FAULT"
    assert len(first) == 200


def test_motion_that_a_silent_model_ignores_is_a_fault() -> None:
    async def scenario() -> None:
        async with watched() as rig:
            camera = rig.track_and_decide.ground_mapper.camera
            blind_s = 0.0
            while rig.recorder.name != "FAULT" or rig.clock.now_s < 110.0:
                across_m = (rig.clock.now_s * 1.2) % 6.0 - 3.0
                uv, _ = camera.project(
                    np.array([(7.0, across_m + dy, up) for dy, up in ((-0.4, 0), (0.4, 1.8))])
                )
                (u1, v1), (u2, v2) = uv.min(0).astype(int), uv.max(0).astype(int)
                picture = RGB + np.uint8(120)
                picture[max(v1, 0) : max(v2, 0), max(u1, 0) : max(u2, 0)] = 20
                await rig.frames(1, 0.25, rgb=picture)
                assert rig.watch is not None
                if rig.watch._look is not None:
                    await asyncio.wait({rig.watch._look})
                blind_s = rig.clock.now_s - 100.0
                assert blind_s < 70.0, rig.watch.numbers
            assert SILENT_S <= blind_s <= 60.0
            assert rig.recorder.signals[-1][0].faults[0].code == "detector.blind"
            rig.detector.answer = PERSON
            await rig.frames(1)
            assert rig.recorder.name != "FAULT"

    asyncio.run(scenario())


@pytest.mark.parametrize("size", [(3840, 2160), (1920, 1080)])
def test_the_bundled_model_finds_the_drawn_picture(size: tuple[int, int]) -> None:
    loaded = load_config(None, ("detection.model=bundled", "detection.threads=1"))
    for road in (None, road_region(loaded)):
        detector = load_detector(loaded.config.detection, loaded.base_dir, road)
        picture = drawn_check_picture(size, detector.decode_size(*size), detector.region)
        assert set(picture.known.kind.tolist()) == {Kind.PEDESTRIAN, Kind.CYCLIST}
        found = detector.infer(picture.rgb, *size).detections
        assert finds_again(picture.known, found)
        assert not finds_again(picture.known, detector.infer(picture.rgb * 0, *size).detections)


def test_the_sites_own_picture_is_read_and_checked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "check.jpg"
    write_check_picture(file, RGB, PERSON, None)
    picture, digest = read_check_picture(file)
    assert digest is None
    assert finds_again(picture.known, PERSON)
    loaded = small(f"detection.check_picture={file}")
    camera, detector = ground_camera(loaded), Rig().detector
    for sha256, used in ((None, True), ("a" * 64, False)):
        write_check_picture(file, RGB, PERSON, sha256)
        with caplog.at_level(logging.WARNING):
            watch = DetectorWatch(loaded, detector, camera, live=True)
        assert (watch._picture is not None) is used
        assert ("another model's" in caplog.text) is not used
        asyncio.run(watch.close())
    write_check_picture(file, RGB[:, :64], PERSON, None)
    with pytest.raises(ConfigError, match="other proportions"):
        DetectorWatch(loaded, detector, camera, live=True)
    write_check_picture(file, RGB, Detections.empty(), None)
    with pytest.raises(BikepedError, match="no known boxes"):
        read_check_picture(file)
    with pytest.raises(BikepedError, match="make it again"):
        read_check_picture(tmp_path / "none.jpg")
    with pytest.raises(BikepedError, match="cannot be written"):
        write_check_picture(tmp_path / "no" / "check.jpg", RGB, PERSON, None)


def test_only_what_is_well_above_the_threshold_is_known() -> None:
    confidence = np.array([0.9, 0.31, 0.29], np.float32)
    found = Detections(np.zeros(3, np.int8), confidence, np.zeros((3, 4), np.float32))
    assert len(known_answers(found, 0.1)) == 2
    assert len(known_answers(found, 0.6)) == 1


def test_align_saves_the_sites_picture_when_asked(tmp_path: Path) -> None:
    loaded = load_config(None, ("detection.model=bundled", "detection.threads=1"))
    detector = load_detector(loaded.config.detection, loaded.base_dir, road_region(loaded))
    size = (1920, 1080)
    drawn = drawn_check_picture(size, detector.decode_size(*size), detector.region)
    street, empty, saved = tmp_path / "street.jpg", tmp_path / "empty.jpg", tmp_path / "check.jpg"
    for file, rgb in ((street, drawn.rgb), (empty, drawn.rgb * 0)):
        write_check_picture(file, rgb, drawn.known, None)  # a JPEG file
    options = ["--set", "detection.model=bundled", "--set", "detection.threads=1"]
    assert main(["align", str(street), *options, "--check-picture", str(saved)]) == 0
    picture, digest = read_check_picture(saved)
    assert digest == detector.model_hash
    found = detector.infer(picture.rgb, picture.frame.width, picture.frame.height).detections
    assert finds_again(picture.known, found)
    assert main(["align", str(empty), *options, "--check-picture", str(saved)]) != 0
    assert main(["align", str(street), *options, "--check-picture", "check.png"]) != 0
