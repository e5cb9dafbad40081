"""Runs a module of bikeped with a light that keeps its colour, and with seams that a row asks for.

`python -m campaign.launch MODULE ARGUMENTS`. The simulated light is replaced at its lowest seam,
`set`: the colour goes into the file CAMPAIGN_LIGHT with the time, one line a change, and stays what
it was when the process dies, as a relay's does. CAMPAIGN_SEAM names a function of
`campaign.seams`, called before the module runs.
"""

from __future__ import annotations

import os
import runpy
import sys
import time

from bikeped.feedback.light import SimulatedLight
from bikeped.types import Colour
from campaign import seams


def keep_colour(path: str) -> None:
    """Lets the simulated light write its changes to the file at `path`."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def write(light: SimulatedLight, colour: Colour) -> None:
        if colour is not light.colour or colour is Colour.OFF:
            os.write(file, f"{time.monotonic():.4f} {colour.value}\n".encode())
        light.colour = colour

    SimulatedLight.set = write  # type: ignore[method-assign]
    SimulatedLight.close = lambda light: write(light, Colour.OFF)  # type: ignore[method-assign]


if __name__ == "__main__":
    keep_colour(os.environ["CAMPAIGN_LIGHT"])
    if seam := os.environ.get("CAMPAIGN_SEAM"):
        getattr(seams, seam)()
    module = sys.argv[1]
    sys.argv = [module, *sys.argv[2:]]
    runpy.run_module(module, run_name="__main__")
