"""`bikeped run`: the service; `bikeped replay`: a recorded video through its loop."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

from bikeped.cli.common import (
    PATH,
    config_options,
    console,
    json_option,
    print_address,
    progress_bar,
    text_table,
    web_option,
    web_overrides,
    write_json,
)
from bikeped.cli.guard import check_outputs, guarded
from bikeped.config.last_good import load_runnable
from bikeped.config.load import LoadedConfig, default_config_path, load_config
from bikeped.config.runnable import warnings
from bikeped.files import make_folder
from bikeped.log_queue import log_through_queue

if TYPE_CHECKING:
    from rich.console import Console

    from bikeped.pipeline.replay import ReplayResult

log = logging.getLogger(__name__)


@click.command("run")
@config_options
@click.option(
    "--last-good",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Keep a configuration that runs well in DIR and run that one where the file is broken.",
)
def run(config_path: Path | None, overrides: tuple[str, ...], last_good: Path | None) -> NoReturn:
    """Run the service until SIGTERM: camera, detection, tracking, decision, light and sound."""
    from bikeped.pipeline.run import run_service
    from bikeped.pipeline.service_start import PLAIN_START, ServiceStart, start_on_pole

    root = logging.getLogger()
    root.setLevel(min(root.level, logging.INFO))
    log_through_queue()

    def serve(loaded: LoadedConfig, start: ServiceStart) -> int:
        for text in warnings(loaded):
            log.warning("%s: %s", loaded.source, text)
        pages = None
        if loaded.config.web.enabled:  # else without the time and memory of its imports
            from bikeped.web.service_pages import ServicePages

            pages = ServicePages(loaded)
        return run_service(loaded, pages=pages, start=start)

    path = config_path or default_config_path()
    if last_good is None:
        status = serve(load_runnable(path, overrides), PLAIN_START)
    else:
        status = start_on_pole(path, overrides, last_good, serve)
    # Everything is stopped and the light is dark. A thread that hangs in a driver must not keep the
    # process alive: exit without joining it.
    logging.shutdown()
    os._exit(status)


@click.command("replay")
@click.argument("video")
@config_options
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for overlay.mp4, events.jsonl and summary.json.",
)
@click.option("--overlay", type=PATH, help="Overlay video, .mp4.")
@click.option("--events", type=PATH, help="Event file, JSON Lines.")
@click.option("--no-mqtt", is_flag=True, help="Do not publish, whatever the configuration says.")
@click.option("--realtime", is_flag=True, help="Run at the recording's frame rate.")
@web_option
@json_option
@guarded
def replay(
    video: str,
    config_path: Path | None,
    overrides: tuple[str, ...],
    out: Path | None,
    overlay: Path | None,
    events: Path | None,
    no_mqtt: bool,
    realtime: bool,
    web_place: str | None,
    json_path: str | None,
) -> int:
    """Run VIDEO (a file or a folder of pictures) through the loop; print its decisions."""
    from bikeped.pipeline.replay import replay as replay_video

    log_through_queue()
    if web_place is not None:
        overrides += web_overrides(web_place)
    loaded = load_config(config_path, overrides)
    pages = None
    if web_place is not None:
        from bikeped.web.service_pages import ServicePages

        pages = ServicePages(loaded)
    if out is not None:
        make_folder(out)
        overlay = overlay or out / "overlay.mp4"
        events = events or out / "events.jsonl"
        names = (("--overlay", overlay), ("--events", events), ("--out", out / "summary.json"))
        check_outputs([("VIDEO", Path(video))], names)
    with progress_bar("replay", None) as progress:
        result = replay_video(
            loaded,
            video,
            events=events,
            overlay=overlay,
            realtime=realtime or pages is not None,
            mqtt=not no_mqtt,
            progress=progress,
            pages=pages,
            serving=print_address,
        )
    summary = result.as_dict()
    if out is not None:
        write_json(summary, str(out / "summary.json"))
    if json_path is not None:
        write_json(summary, json_path)
    if json_path != "-":
        _print_result(console(), result)
        for path in (overlay, events, None if out is None else out / "summary.json"):
            if path is not None:
                click.echo(f"wrote {path}")
    if result.interrupted:
        text = f"interrupted after {result.frames} frames; what was written ends there"
        click.echo(f"bikeped: {text}", err=True)
        return 130
    return 0


def counted(number: int, what: str) -> str:
    """`1 frame`, `2 frames`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _print_result(screen: Console, result: ReplayResult) -> None:
    """The summary for people."""
    data = result.as_dict()
    screen.print(
        f"{data['frames']} frames, {data['duration_s']:.1f} s of recording, "
        f"{data['frames_per_second']:.1f} frames/s; detector: {data['detector']}"
    )
    if data["undecodable"]:
        screen.print(f"{counted(data['undecodable'], 'frame')} did not decode and were skipped")
    found = ", ".join(f"{count} {kind}" for kind, count in data["tracks"].items()) or "none"
    screen.print(f"tracks: {found}")
    total = max(1, sum(data["states"].values()))
    shares = ", ".join(f"{s} {n / total:.1%}" for s, n in data["states"].items())
    screen.print(f"states: {shares}")
    for alert in data["alerts"]:
        screen.print(
            f"  {alert['t']:7.2f} s  {alert['sentence']} ({counted(alert['frames'], 'frame')})"
        )
    columns = ("mean", "p50", "p95", "p99", "max")
    rows = [
        (stage, *(f"{row[name]:.2f}" for name in columns))
        for stage, row in data["latency_ms"].items()
    ]
    screen.print(text_table(("stage", *columns), rows, title="latency, ms"))
