"""`bikeped run` with seams: a word on standard input says what is to go wrong inside it.

`hold SECONDS` holds the interpreter, as C code that keeps the lock does; `block SECONDS` stops the
event loop; `log LINES` writes log lines from the loop.
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import sys
import threading
import time

import bikeped.pipeline.run as run
from bikeped.cli.main import main

loops: list[asyncio.AbstractEventLoop] = []
ordinary_run = run._run


async def noted(*arguments: object) -> int:
    loops.append(asyncio.get_running_loop())
    return await ordinary_run(*arguments)  # type: ignore[arg-type]


def write_lines(count: int) -> None:
    for number in range(count):
        logging.getLogger("bikeped.test").warning("line %d of many that say nothing", number)


def obey() -> None:
    for line in sys.stdin:
        word, number = line.split()
        if word == "hold":
            ctypes.PyDLL(None).usleep(int(float(number) * 1e6))
        elif word == "block":
            loops[0].call_soon_threadsafe(time.sleep, float(number))
        elif word == "log":
            loops[0].call_soon_threadsafe(write_lines, int(number))


run._run = noted
threading.Thread(target=obey, daemon=True).start()
sys.exit(main(sys.argv[1:]))
