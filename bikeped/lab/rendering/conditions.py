"""Light and weather of a drawn scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bikeped.errors import ScenarioError
from bikeped.types import FloatArray

#: By light: sun, ambient, top and low of the sky (see `Lighting`), haze_m, factor on the noise.
_LIGHTS = {
    "day": ((0.66, 0.61, 0.53), (0.46, 0.49, 0.54), (92, 146, 208), (206, 217, 226), 240.0, 1.0),
    "overcast": ((0, 0, 0), (0.76, 0.77, 0.8), (168, 174, 182), (204, 207, 210), 170.0, 1.0),
    "dusk": ((0.62, 0.40, 0.22), (0.27, 0.29, 0.38), (72, 92, 142), (222, 166, 122), 240.0, 1.5),
    "night": ((0, 0, 0), (0.15, 0.16, 0.21), (10, 12, 22), (38, 34, 38), 300.0, 1.7),
    "glare": ((0.85, 0.78, 0.64), (0.36, 0.37, 0.40), (142, 172, 208), (246, 236, 212), 240.0, 1.0),
}
LIGHTS = tuple(_LIGHTS)
WEATHERS = ("dry", "rain")


@dataclass(frozen=True)
class Conditions:
    """Appearance of a scene apart from its road users.

    `seed`: clothes, paints, noise. `light`: day, overcast, dusk, night, glare. `weather`: dry,
    rain. `place`: road layout, houses, textures and occluders (poles, trees, parked cars); 0 is
    the plain street of the bundled scenarios. `noise`: standard deviation of the sensor's noise in
    grey levels by day; darkness raises it. `clutter`: this many more bollards, bins, signs and
    hydrants near the default camera than the place has.
    """

    seed: int = 0
    light: str = "day"
    weather: str = "dry"
    place: int = 0
    noise: float = 2.5
    clutter: int = 0

    def __post_init__(self) -> None:
        if self.light not in LIGHTS:
            raise ScenarioError(f"light: {self.light!r} is not one of {', '.join(LIGHTS)}")
        if self.weather not in WEATHERS:
            raise ScenarioError(f"weather: {self.weather!r} is not one of {', '.join(WEATHERS)}")
        if not 0 <= self.noise <= 40:
            raise ScenarioError(f"noise: {self.noise} is not 0 to 40 grey levels")
        if min(self.seed, self.place, self.clutter) < 0:
            raise ScenarioError("seed, place, clutter: must not be negative")


@dataclass(frozen=True)
class Lighting:
    """Conditions made into numbers. Colours are factors [3] on reflected colours in 0..255.

    `to_sun` [3]: unit vector in the world; `sun` zero where none shines. `sky_top`, `sky_low` and
    `haze` are colours in 0..255. `noise`: standard deviation in grey levels.
    """

    to_sun: FloatArray
    sun: FloatArray
    ambient: FloatArray
    sky_top: FloatArray
    sky_low: FloatArray
    clouds: float
    haze_m: float  #: distance at which haze takes over
    lamps: bool
    wet: bool
    glare: float
    noise: float

    @property
    def shade(self) -> FloatArray:
        """What a shadow leaves of the light on level ground [3]."""
        return np.asarray(self.ambient / np.maximum(self.ground, 1e-6))

    @property
    def ground(self) -> FloatArray:
        """Light on level ground [3]."""
        return np.asarray(self.ambient + self.sun * max(float(self.to_sun[2]), 0.0))


def lighting(conditions: Conditions) -> Lighting:
    """The light of these conditions; sun and strength vary with `seed` and `place`."""
    rng = np.random.default_rng((conditions.seed, conditions.place, 11))
    kind, wet = conditions.light, conditions.weather == "rain"
    azimuth = math.radians(float(rng.uniform(0, 360)))
    height = math.radians(float(rng.uniform(28, 62)))
    gain = float(rng.uniform(0.88, 1.1))
    warm = float(rng.uniform(-0.03, 0.03))
    clouds, glare = float(rng.uniform(0.1, 0.8)), 0.0
    *colours, haze, noise_gain = _LIGHTS[kind]
    sun, ambient, top, low = (np.array(colour, np.float64) for colour in colours)
    noise = conditions.noise * noise_gain
    if kind == "overcast":
        clouds = 0.5
    elif kind == "dusk":
        height = math.radians(float(rng.uniform(7, 16)))
    elif kind == "night":
        # A crossing is lit and a camera raises its gain: everyone can be made out on a close look.
        ambient, clouds = ambient * float(rng.uniform(1.2, 1.8)), 0.15
    elif kind == "glare":
        # In the picture: within 50 degrees of north, the default camera's heading, and low.
        azimuth = math.radians(90 + float(rng.uniform(-50, 50)))
        height = math.radians(float(rng.uniform(9, 24)))
        glare = float(rng.uniform(0.6, 1.0))
    if wet:
        sun = sun * 0.12
        ambient = ambient * (np.array([0.86, 0.88, 0.9]) if kind != "night" else 1.0)
        grey = np.array([0.30, 0.59, 0.11])
        top = 0.35 * top + 0.65 * float(top @ grey)
        low = 0.4 * low + 0.6 * float(low @ grey)
        clouds, haze, glare, noise = 0.6, haze * 0.45, glare * 0.35, noise * 1.2
    tint = gain * np.array([1 + warm, 1.0, 1 - warm])
    level = math.cos(height)
    return Lighting(
        to_sun=np.array([math.cos(azimuth) * level, math.sin(azimuth) * level, math.sin(height)]),
        sun=sun * tint,
        ambient=ambient * tint,
        sky_top=top * gain,
        sky_low=low * gain,
        clouds=clouds,
        haze_m=haze,
        lamps=kind in {"night", "dusk"},
        wet=wet,
        glare=glare,
        noise=noise,
    )


def random_conditions(seed: int, clutter: int = 0) -> Conditions:
    """Conditions for training: every light, weather and place, noise from clean to grainy, and up
    to `clutter` more things near the camera."""
    rng = np.random.default_rng((seed, 23))
    return Conditions(
        seed=int(rng.integers(1 << 30)),
        light=str(rng.choice(LIGHTS, p=[0.4, 0.22, 0.13, 0.13, 0.12])),
        weather="rain" if rng.random() < 0.18 else "dry",
        place=int(rng.integers(1 << 30)),
        noise=float(round(rng.uniform(0.5, 5.0), 2)),
        clutter=int(rng.integers(clutter + 1)),
    )
