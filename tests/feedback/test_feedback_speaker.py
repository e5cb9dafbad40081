"""The speaker, playing through a fake `aplay` on PATH."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from bikeped.config.output_sections import SoundConfig
from bikeped.errors import FeedbackError
from bikeped.feedback.sounds import make_wav
from bikeped.feedback.speaker import Speaker
from bikeped.types import Sound

# The fake notes its arguments and what it was fed; `mode` says how it then behaves.
APLAY = """#!/bin/sh
dir={dir}
n=$(ls "$dir" | grep -c '^args')
echo "$@" > "$dir/args.$n"
case "$(cat "$dir/mode")" in
  fail) cat > /dev/null; echo "aplay: main:831: audio open error: No such device" >&2; exit 1 ;;
  deaf) echo $$ > "$dir/pid.$n"; trap '' TERM; while :; do sleep 1; done ;;
  hang) echo $$ > "$dir/pid.$n"; exec sleep 600 ;;
esac
cat > "$dir/part.$n"; mv "$dir/part.$n" "$dir/wav.$n"
"""


class Clock:
    def __init__(self) -> None:
        self.now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


class Aplay:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.mode("play")

    def mode(self, mode: str) -> None:
        (self.folder / "mode").write_text(mode)

    def heard(self) -> list[bytes]:
        return [path.read_bytes() for path in sorted(self.folder.glob("wav.*"))]

    def pids(self) -> list[int]:
        return [int(path.read_text()) for path in sorted(self.folder.glob("pid.*"))]

    async def until(self, condition: Callable[[], bool]) -> None:
        """Waits for the child, which is another process: polling is all there is."""

        async def poll() -> None:
            while not condition():  # noqa: ASYNC110 - another process sends no event
                await asyncio.sleep(0.005)

        await asyncio.wait_for(poll(), 20)

    async def running(self) -> int:
        """The process id of the newest hanging child, once it has written it."""

        def written() -> bool:
            files = list(self.folder.glob("pid.*"))
            return bool(files) and all(path.read_text().strip() for path in files)

        await self.until(written)
        return self.pids()[-1]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def aplay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Aplay:
    folder = tmp_path / "notes"
    folder.mkdir()
    program = tmp_path / "bin" / "aplay"
    program.parent.mkdir()
    program.write_text(APLAY.format(dir=folder))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    return Aplay(folder)


Make = Callable[..., Speaker]


@pytest.fixture
async def make(clock: Clock) -> AsyncIterator[Make]:
    made: list[Speaker] = []

    def build(grace_s: float = 20.0, base: Path | None = None, **config: object) -> Speaker:
        settings = SoundConfig(**{"enabled": True, **config})  # type: ignore[arg-type]
        made.append(Speaker(settings, base=base, grace_s=grace_s, clock=clock))
        return made[-1]

    yield build
    for speaker in made:
        await speaker.close()


@pytest.fixture
def clock() -> Clock:
    return Clock()


async def test_plays_through_aplay_on_the_configured_device(aplay: Aplay, make: Make) -> None:
    speaker = make(device="plughw:1,0", volume=0.5)
    assert speaker.play(Sound.CHIME)
    await speaker.wait()
    assert aplay.heard() == [make_wav(Sound.CHIME, 0.5)]
    assert (aplay.folder / "args.0").read_text() == "-q -D plughw:1,0\n"
    assert speaker.fault is None


async def test_silence_and_a_disabled_speaker_start_nothing(aplay: Aplay, make: Make) -> None:
    assert not make().play(Sound.NONE)
    assert not make(enabled=False).play(Sound.BELL)
    assert not list(aplay.folder.glob("args.*"))


async def test_the_bell_repeats_at_its_cooldown_while_alert_lasts(
    aplay: Aplay, make: Make, clock: Clock
) -> None:
    speaker = make(bell_cooldown_s=1.5)
    starts_s = []
    for _ in range(121):
        if speaker.play(Sound.BELL):
            starts_s.append(clock.now_s - 50)
            await speaker.wait()
        clock.now_s += 1 / 30
    assert len(starts_s) == 3
    assert starts_s == pytest.approx([0, 1.5, 3.0], abs=0.1)
    assert aplay.heard() == [make_wav(Sound.BELL, 0.8)] * 3


async def test_the_chime_has_a_cooldown_of_its_own(aplay: Aplay, make: Make, clock: Clock) -> None:
    speaker = make(chime_cooldown_s=5.0)
    assert speaker.play(Sound.CHIME)
    await speaker.wait()
    clock.now_s += 4.9
    assert not speaker.play(Sound.CHIME)
    assert speaker.play(Sound.BELL)
    await speaker.wait()
    clock.now_s += 0.2
    assert speaker.play(Sound.CHIME)


async def test_the_bell_interrupts_a_chime_and_nothing_a_bell(
    aplay: Aplay, make: Make, clock: Clock
) -> None:
    aplay.mode("hang")
    speaker = make(bell_cooldown_s=0, chime_cooldown_s=0)
    assert speaker.play(Sound.CHIME)
    chime_pid = await aplay.running()
    assert not speaker.play(Sound.CHIME)
    assert speaker.play(Sound.BELL)
    assert speaker.playing is Sound.BELL
    await aplay.until(lambda: len(list(aplay.folder.glob("pid.*"))) == 2)
    assert not alive(chime_pid)
    assert not speaker.play(Sound.CHIME)
    assert not speaker.play(Sound.BELL)
    assert speaker.fault is None


async def test_play_returns_before_the_sound_has_ended(aplay: Aplay, make: Make) -> None:
    aplay.mode("hang")
    speaker = make()
    assert speaker.play(Sound.BELL)
    assert speaker.playing is Sound.BELL
    await aplay.running()
    assert speaker.playing is Sound.BELL


@pytest.mark.parametrize("mode", ["hang", "deaf"])
async def test_a_hung_aplay_is_killed_and_is_a_fault(aplay: Aplay, make: Make, mode: str) -> None:
    aplay.mode(mode)
    speaker = make(grace_s=-0.5, volume=1.0)
    speaker.play(Sound.BELL)
    pid = await aplay.running()
    await speaker.wait()
    assert not alive(pid)
    assert speaker.fault is not None
    assert "hung for 0.7 s and was killed" in str(speaker.fault)


async def test_a_failure_is_reported_paused_and_mended(
    aplay: Aplay, make: Make, clock: Clock
) -> None:
    aplay.mode("fail")
    speaker = make(bell_cooldown_s=0)
    speaker.play(Sound.BELL)
    await speaker.wait()
    assert str(speaker.fault) == (
        "speaker: aplay ended with 1: aplay: main:831: audio open error: No such device"
    )
    assert not speaker.play(Sound.BELL)
    clock.now_s += 2.0
    aplay.mode("play")
    assert speaker.play(Sound.BELL)
    await speaker.wait()
    assert speaker.fault is None
    assert len(aplay.heard()) == 1


async def test_a_missing_aplay_is_a_fault_not_a_crash(
    make: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    speaker = make()
    speaker.play(Sound.BELL)
    await speaker.wait()
    assert speaker.fault is not None
    assert "aplay cannot be run" in str(speaker.fault)
    assert "alsa-utils" in str(speaker.fault)


async def test_close_ends_the_child_and_starts_no_more(aplay: Aplay, make: Make) -> None:
    aplay.mode("hang")
    speaker = make()
    speaker.play(Sound.BELL)
    pid = await aplay.running()
    await speaker.close()
    assert not alive(pid)
    assert not speaker.play(Sound.BELL)
    assert speaker.fault is None


async def test_closing_at_once_leaves_no_child(aplay: Aplay, make: Make) -> None:
    aplay.mode("hang")
    speaker = make()
    speaker.play(Sound.CHIME)
    speaker.play(Sound.BELL)
    await speaker.close()
    assert not any(alive(pid) for pid in aplay.pids())


async def test_the_users_files_are_found_beside_the_configuration(
    aplay: Aplay, make: Make, tmp_path: Path
) -> None:
    (tmp_path / "ding.wav").write_bytes(make_wav(Sound.CHIME, 1.0))
    speaker = make(bell="ding.wav", volume=1.0, base=tmp_path)
    speaker.play(Sound.BELL)
    await speaker.wait()
    assert aplay.heard() == [make_wav(Sound.CHIME, 1.0)]


async def test_an_unusable_file_is_refused_at_the_start(make: Make, tmp_path: Path) -> None:
    with pytest.raises(FeedbackError, match=r"feedback\.sound\.chime: .*none\.wav"):
        make(chime=str(tmp_path / "none.wav"))
