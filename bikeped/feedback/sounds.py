"""The chime and the bell, made here by additive synthesis; and the user's own WAV files.

Both sounds are sums of decaying sines: no recording, no random number, the same bytes every time.
The chime is two soft harmonic notes, a falling major third as of a doorbell. The bell is struck
twice like a bicycle's: its partials are inharmonic, the ratios being the classic ones of a tuned
bell (hum, prime, minor third, fifth, nominal and above; Fletcher and Rossing, The Physics of
Musical Instruments, chapter 21), and the higher a partial the sooner it dies away.
"""

from __future__ import annotations

import io
import wave
from pathlib import Path

import numpy as np

from bikeped.errors import FeedbackError
from bikeped.types import FloatArray, Sound

RATE_HZ = 48_000
#: Longest sound that is accepted, seconds: a bell must be able to repeat.
MAX_DURATION_S = 10.0

_CHIME_NOTES_HZ = (659.255, 523.251)  # E5, C5
_CHIME_PARTIALS = ((1.0, 1.0, 0.45), (2.0, 0.3, 0.25), (3.0, 0.08, 0.15))
_CHIME_SPACING_S = 0.28
_CHIME_S = 1.1

_BELL_PRIME_HZ = 1318.51  # E6: above most traffic noise, within what elderly ears hear well
#: (frequency ratio to the prime, amplitude, time constant of the decay in seconds)
_BELL_PARTIALS = (
    (0.5, 0.35, 0.55),
    (1.0, 1.0, 0.40),
    (1.183, 0.55, 0.32),
    (1.506, 0.40, 0.28),
    (2.0, 0.90, 0.22),
    (2.514, 0.35, 0.16),
    (2.662, 0.30, 0.14),
    (3.011, 0.25, 0.11),
    (4.166, 0.20, 0.07),
)
_BELL_SPACING_S = 0.18
_BELL_S = 1.2

_ATTACK_S = 0.002
_FADE_S = 0.03


#: Of each sound: its notes in Hz, their partials, the seconds between them, and its length.
_SOUNDS = {
    Sound.CHIME: (_CHIME_NOTES_HZ, _CHIME_PARTIALS, _CHIME_SPACING_S, _CHIME_S),
    Sound.BELL: ((_BELL_PRIME_HZ, _BELL_PRIME_HZ), _BELL_PARTIALS, _BELL_SPACING_S, _BELL_S),
}


def synthesise(sound: Sound) -> FloatArray:
    """The chime or the bell at `RATE_HZ`, samples in -1..1, peak 1; KeyError for `Sound.NONE`.

    Each note rings to the end, which fades out.
    """
    notes_hz, partials, spacing_s, length_s = _SOUNDS[sound]
    out = np.zeros(round(length_s * RATE_HZ))
    for index, note_hz in enumerate(notes_hz):
        start = round(index * spacing_s * RATE_HZ)
        t = np.arange(out.size - start) / RATE_HZ
        # A few milliseconds of attack: a step at the start would click.
        attack = np.minimum(t / _ATTACK_S, 1.0)
        for ratio, amplitude, decay_s in partials:
            wave_form = np.sin(2 * np.pi * note_hz * ratio * t)
            out[start:] += amplitude * np.exp(-t / decay_s) * attack * wave_form
    fade = round(_FADE_S * RATE_HZ)
    out[-fade:] *= np.linspace(1.0, 0.0, fade)
    scaled: FloatArray = out / float(np.abs(out).max())
    return scaled


def make_wav(sound: Sound, volume: float) -> bytes:
    """bikeped's own `sound` as a WAV file: 48 kHz, 16 bit, mono; `volume` 0 (silent) to 1 (full).

    Raises KeyError for `Sound.NONE`.
    """
    return encode_wav(synthesise(sound) * 32767 * volume, RATE_HZ, 1)


def load_wav(path: Path, key: str, volume: float) -> bytes:
    """The user's WAV file at `volume` (0..1), checked and re-encoded.

    `key` is the configuration key to name. Raises FeedbackError unless the file is 16-bit PCM, mono
    or stereo, 8 to 192 kHz, not empty and at most `MAX_DURATION_S` long.
    """
    try:
        with wave.open(str(path), "rb") as file:
            channels, width = file.getnchannels(), file.getsampwidth()
            rate_hz, count = file.getframerate(), file.getnframes()
            # Read bounded: the header's own count is not to be trusted.
            data = file.readframes(min(count, int(MAX_DURATION_S * 192_000) + 1))
    except (OSError, EOFError, wave.Error) as error:
        raise FeedbackError(f"{key}: {path} is not a readable WAV file: {error}") from error
    if width != 2 or channels not in (1, 2) or not 8_000 <= rate_hz <= 192_000:
        raise FeedbackError(
            f"{key}: {path} has {8 * width} bit, {channels} channels, {rate_hz} Hz; needed are 16 "
            "bit PCM, 1 or 2 channels, 8000 to 192000 Hz"
        )
    duration_s = len(data) / (2 * channels * rate_hz)
    if not 0 < duration_s <= MAX_DURATION_S:
        raise FeedbackError(
            f"{key}: {path} lasts {duration_s:g} s; needed is more than 0 and at most "
            f"{MAX_DURATION_S:g} s"
        )
    whole = len(data) - len(data) % (2 * channels)
    return encode_wav(np.frombuffer(data[:whole], "<i2") * volume, rate_hz, channels)


def encode_wav(samples: FloatArray, rate_hz: int, channels: int) -> bytes:
    """Samples of +-32767 (interleaved when stereo) as the bytes of a 16-bit WAV file."""
    buffer = io.BytesIO()
    with wave.open(buffer, "wb") as file:
        file.setnchannels(channels)
        file.setsampwidth(2)
        file.setframerate(rate_hz)
        file.writeframes(np.round(samples).astype("<i2").tobytes())
    return buffer.getvalue()


def duration_s(wav: bytes) -> float:
    """How long a WAV file made here plays, seconds."""
    with wave.open(io.BytesIO(wav), "rb") as file:
        return file.getnframes() / file.getframerate()
