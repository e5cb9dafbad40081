"""The synthesised sounds and the user's WAV files."""

from __future__ import annotations

import hashlib
import io
import wave
from pathlib import Path

import numpy as np
import pytest

from bikeped.errors import FeedbackError
from bikeped.feedback.sounds import RATE_HZ, duration_s, encode_wav, load_wav, make_wav, synthesise
from bikeped.types import FloatArray, Sound


def samples(wav: bytes) -> np.ndarray[tuple[int], np.dtype[np.int16]]:
    with wave.open(io.BytesIO(wav)) as file:
        assert (file.getframerate(), file.getsampwidth(), file.getnchannels()) == (RATE_HZ, 2, 1)
        return np.frombuffer(file.readframes(file.getnframes()), "<i2")


def peaks_hz(sound: FloatArray, start_s: float, end_s: float, count: int) -> list[float]:
    """The `count` strongest spectral peaks between two times, ascending."""
    part = sound[round(start_s * RATE_HZ) : round(end_s * RATE_HZ)]
    spectrum = np.abs(np.fft.rfft(part * np.hanning(part.size), 4 * part.size))
    inner = spectrum[1:-1]
    tops = np.flatnonzero((inner > spectrum[:-2]) & (inner >= spectrum[2:])) + 1
    strongest = tops[np.argsort(spectrum[tops])[-count:]]
    return sorted(float(index) * RATE_HZ / (4 * part.size) for index in strongest)


@pytest.mark.parametrize("sound", [Sound.CHIME, Sound.BELL])
def test_the_same_bytes_every_time(sound: Sound) -> None:
    first, second = (hashlib.sha256(make_wav(sound, 0.8)).hexdigest() for _ in range(2))
    assert first == second


@pytest.mark.parametrize("which", [Sound.CHIME, Sound.BELL])
def test_starts_and_ends_without_a_click_and_uses_the_full_scale(which: Sound) -> None:
    sound = synthesise(which)
    assert np.abs(sound).max() == pytest.approx(1.0)
    assert sound[0] == 0.0
    assert sound[-1] == 0.0
    assert abs(sound.mean()) < 0.01


def test_the_chime_has_two_notes_falling_by_a_major_third() -> None:
    (first,) = peaks_hz(synthesise(Sound.CHIME), 0.0, 0.27, 1)
    (second,) = peaks_hz(synthesise(Sound.CHIME), 0.7, 1.1, 1)
    assert first / second == pytest.approx(2 ** (4 / 12), rel=0.01)


def test_the_bell_is_inharmonic_and_dies_away() -> None:
    strong = peaks_hz(synthesise(Sound.BELL), 0.2, 0.6, 4)
    prime = 1318.51
    # The bell's minor third is what no string and no horn has.
    assert any(abs(peak / prime - 1.183) < 0.02 for peak in strong)
    start, end = synthesise(Sound.BELL)[:9600], synthesise(Sound.BELL)[-9600:]
    assert np.sqrt((end**2).mean()) < 0.2 * np.sqrt((start**2).mean())


def test_the_bell_is_struck_twice() -> None:
    sound = np.abs(synthesise(Sound.BELL))
    before = sound[round(0.15 * RATE_HZ) : round(0.18 * RATE_HZ)].max()
    after = sound[round(0.18 * RATE_HZ) : round(0.21 * RATE_HZ)].max()
    assert after > 1.2 * before


@pytest.mark.parametrize(("volume", "peak"), [(0.0, 0), (0.5, 16384), (1.0, 32767)])
def test_volume_scales(volume: float, peak: int) -> None:
    wav = make_wav(Sound.BELL, volume)
    assert np.abs(samples(wav).astype(int)).max() == pytest.approx(peak, abs=1)
    assert 0.5 < duration_s(wav) < 2.0


def test_silence_has_no_wav() -> None:
    with pytest.raises(KeyError, match="NONE"):
        make_wav(Sound.NONE, 1.0)


def test_the_users_file_is_taken_at_the_volume(tmp_path: Path) -> None:
    path = tmp_path / "mine.wav"
    path.write_bytes(encode_wav(np.array([1000.0, -1000.0] * 4000), 16000, 2))
    with wave.open(io.BytesIO(load_wav(path, "feedback.sound.bell", 0.5))) as file:
        assert (file.getframerate(), file.getnchannels(), file.getnframes()) == (16000, 2, 4000)
        assert set(np.frombuffer(file.readframes(4000), "<i2")) == {500, -500}


def _wav(path: Path, width: int, channels: int, rate_hz: int, frames: int) -> None:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(channels)
        file.setsampwidth(width)
        file.setframerate(rate_hz)
        file.writeframes(b"\0" * width * channels * frames)


@pytest.mark.parametrize(
    ("width", "channels", "rate_hz", "frames", "message"),
    [
        (1, 1, 8000, 800, "8 bit"),
        (3, 1, 48000, 800, "24 bit"),
        (2, 3, 48000, 800, "3 channels"),
        (2, 1, 4000, 800, "4000 Hz"),
        (2, 1, 8000, 0, "lasts 0 s"),
        (2, 1, 8000, 80001, "at most 10 s"),
    ],
)
def test_files_that_cannot_serve_are_refused(
    tmp_path: Path, width: int, channels: int, rate_hz: int, frames: int, message: str
) -> None:
    path = tmp_path / "x.wav"
    _wav(path, width, channels, rate_hz, frames)
    with pytest.raises(FeedbackError, match=rf"feedback\.sound\.chime: .*{message}"):
        load_wav(path, "feedback.sound.chime", 1.0)


@pytest.mark.parametrize("content", [None, b"", b"RIFF", b"OggS" + b"\0" * 100])
def test_files_that_are_no_wav_are_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "x.wav"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FeedbackError, match="not a readable WAV file"):
        load_wav(path, "feedback.sound.chime", 1.0)


def test_a_file_cut_short_is_taken_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "x.wav"
    _wav(path, 2, 2, 8000, 8000)
    path.write_bytes(path.read_bytes()[:-16001])
    assert 0.4 < duration_s(load_wav(path, "k", 1.0)) < 0.6
