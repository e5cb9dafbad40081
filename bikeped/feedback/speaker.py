"""The speaker: plays chime and bell by `aplay` (package alsa-utils), never blocking.

`aplay -q -D <device>` without a file name reads a WAV file from its standard input (aplay(1)). It
runs as a child process, so a sound card that hangs hangs the child, which is then killed; nothing
of ALSA lives in the service.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from bikeped.config.output_sections import SoundConfig
from bikeped.faults import Fault
from bikeped.feedback.sounds import duration_s, load_wav, make_wav
from bikeped.types import Sound

_log = logging.getLogger(__name__)

RETRY_S = 2.0  #: the shortest pause after a failure


class Speaker:
    """Plays one sound at a time; all methods belong to the event loop's thread.

    The bell interrupts a chime; nothing interrupts a bell. A sound within its cool-down (counted
    from start to start), or while a sound of at least its rank plays, is dropped, not queued: a
    late bell would warn of what is over. ALERT asks for the bell with every frame, so it repeats at
    its cool-down.

    `base` is the folder that relative WAV paths of the configuration start from. `grace_s`: how
    much longer than the sound a child may live. `fault` says why the last sound was not heard.
    Raises FeedbackError when a configured WAV file is unusable.
    """

    def __init__(
        self,
        config: SoundConfig,
        *,
        base: Path | None = None,
        grace_s: float = 3.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._enabled = config.enabled
        self._command = ("aplay", "-q", "-D", config.device)
        self._cooldown_s = {
            Sound.CHIME: config.chime_cooldown_s,
            Sound.BELL: config.bell_cooldown_s,
        }
        self._grace_s, self._clock = grace_s, clock
        self._wavs: dict[Sound, bytes] = {}
        if config.enabled:
            for sound, name in ((Sound.CHIME, config.chime), (Sound.BELL, config.bell)):
                if name is None:
                    self._wavs[sound] = make_wav(sound, config.volume)
                else:
                    path, key = Path(name).expanduser(), f"feedback.sound.{sound.value}"
                    self._wavs[sound] = load_wav((base or Path()) / path, key, config.volume)
        self._ready_s = {Sound.CHIME: float("-inf"), Sound.BELL: float("-inf")}
        self._task: asyncio.Task[None] | None = None
        # The interrupted ones too, until their children have gone.
        self._tasks: set[asyncio.Task[None]] = set()
        self._playing = Sound.NONE
        self.fault: Fault | None = None

    @property
    def playing(self) -> Sound:
        """The sound that plays now."""
        return self._playing if self._task is not None and not self._task.done() else Sound.NONE

    def play(self, sound: Sound) -> bool:
        """Starts `sound`, or drops it; returns at once whether it was started.

        Call it with the `sound` of every signal, `Sound.NONE` included.
        """
        if not self._enabled or sound is Sound.NONE:
            return False
        now_s = self._clock()
        busy = self.playing
        if now_s < self._ready_s[sound] or busy is Sound.BELL or busy is sound:
            return False
        before = self._task
        if before is not None and busy is not Sound.NONE:
            before.cancel()
        self._ready_s[sound] = now_s + self._cooldown_s[sound]
        self._playing = sound
        self._task = asyncio.get_running_loop().create_task(
            self._run(sound, before), name=f"bikeped-{sound.value}"
        )
        self._tasks.add(self._task)
        self._task.add_done_callback(self._tasks.discard)
        return True

    async def close(self) -> None:
        """Stops the sound that plays and lets no further one start."""
        self._enabled = False
        for task in self._tasks:
            task.cancel()
        await self.wait()

    async def wait(self) -> None:
        """Waits until no sound plays (tests, and the check of the speaker)."""
        if self._tasks:
            await asyncio.wait(set(self._tasks))

    async def _run(self, sound: Sound, before: asyncio.Task[None] | None) -> None:
        if before is not None and not before.done():
            # The interrupted child holds the sound card until it has gone.
            await asyncio.wait({before})
        error = await self._play(self._wavs[sound])
        if error is None:
            if self.fault is not None:
                _log.warning("speaker: works again")
            self.fault = None
            return
        fault = Fault("speaker", "speaker.error", error)
        if fault != self.fault:
            _log.log(fault.kind.severity, "%s", fault)
        self.fault = fault
        # A broken card must not cost a process thirty times a second, whatever the cool-down.
        self._ready_s[sound] = max(self._ready_s[sound], self._clock() + RETRY_S)

    async def _play(self, wav: bytes) -> str | None:
        """Plays one WAV file; returns what went wrong, or None."""
        program = self._command[0]
        limit_s = duration_s(wav) + self._grace_s
        # Files in memory and not pipes: a child that does not read, or that leaves a descendant
        # behind, can then neither block the loop nor leak a transport.
        with _memory_file("bikeped-sound", wav) as stdin, _memory_file("bikeped-stderr") as stderr:
            try:
                child = await asyncio.create_subprocess_exec(
                    *self._command, stdin=stdin, stdout=asyncio.subprocess.DEVNULL, stderr=stderr
                )
            except (OSError, ValueError, RuntimeError) as error:
                return f"{program} cannot be run: {error}; install alsa-utils"
            try:
                await asyncio.wait_for(child.wait(), limit_s)
            except asyncio.TimeoutError:
                return f"{program} hung for {limit_s:.1f} s and was killed"
            finally:
                # Also on cancellation: no child outlives its sound.
                await _end(child)
            if child.returncode == 0:
                return None
            stderr.seek(0)
            said = stderr.read(4096).decode("utf-8", "replace").strip().splitlines()
        return f"{program} ended with {child.returncode}: {(said or ['no message'])[-1]}"


def _memory_file(name: str, content: bytes = b"") -> BinaryIO:
    """An open file that lives in memory, at its start."""
    file = os.fdopen(os.memfd_create(name), "w+b", buffering=0)
    file.write(content)
    file.seek(0)
    return file


async def _end(child: asyncio.subprocess.Process) -> None:
    """Ends a child that may still run: asks first (ALSA's dmix likes a clean exit), then kills."""
    for signal_it, patience_s in ((child.terminate, 0.3), (child.kill, 2.0)):
        if child.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            signal_it()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(child.wait(), patience_s)
