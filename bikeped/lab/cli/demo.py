"""`bikeped demo`: a drawn crossing through the whole pipeline, without camera and broker."""

from __future__ import annotations

import json
from pathlib import Path

import click

from bikeped.cli.common import (
    FiniteRange,
    config_options,
    json_option,
    print_address,
    progress_bar,
    web_option,
    web_overrides,
    write_json,
)
from bikeped.cli.guard import check_outputs, guarded, written_paths
from bikeped.config.load import load_config
from bikeped.errors import BikepedError
from bikeped.files import make_folder, write_whole
from bikeped.lab.cli.model import report

SIZE = (1920, 1080)
FPS = 30


@click.command("demo")
@config_options
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("demo-out"),
    show_default=True,
    help="Folder for the clip, the overlay video, the events and the summary.",
)
@click.option(
    "--seconds", type=FiniteRange(min=0.1), help="Run only the first seconds of the crossing."
)
@web_option
@json_option
@guarded
def command(
    config_path: Path | None,
    overrides: tuple[str, ...],
    out: Path,
    seconds: float | None,
    web_place: str | None,
    json_path: str | None,
) -> None:
    """Draw a scripted crossing as fisheye video and replay it through the whole pipeline.

    Uses the bundled detector where none is configured.
    """
    from bikeped.lab.demo.summary import bundled_scenario, format_summary, summarise
    from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera, sidecar_path
    from bikeped.lab.rendering.clip import frame_times, write_clip
    from bikeped.lab.scenarios.scenario import load_scenario
    from bikeped.models import BUNDLED, NOT_FOR_STREETS
    from bikeped.pipeline.replay import replay
    from bikeped.telemetry.http_server import port_error

    if web_place is not None:
        overrides += web_overrides(web_place)
    loaded = load_config(config_path, overrides)
    if loaded.config.detection.model is None:
        loaded = load_config(config_path, (f"detection.model={BUNDLED}", *overrides))
    pages = None
    if web_place is not None:
        from bikeped.web.service_pages import ServicePages

        pages = ServicePages(loaded)
    clip, events, overlay = out / "crossing.avi", out / "events.jsonl", out / "overlay.mp4"
    names = [clip, sidecar_path(clip), events, overlay, out / "summary.txt", out / "summary.json"]
    if pages is not None and (refused := port_error(loaded.config.web)) is not None:
        raise BikepedError(refused)  # before a minute of drawing, not after
    make_folder(out)
    outputs = [("--out", name) for name in names]
    outputs += [("--json", name) for name in written_paths(json_path)]
    check_outputs([("-c", config_path)] if config_path is not None else [], outputs)
    scenario = load_scenario(bundled_scenario())
    painter = ScenePainter(scenario, scene_camera(loaded, SIZE), Conditions())
    frames = len(frame_times(painter, FPS, seconds))
    with progress_bar("drawing", frames) as progress:
        write_clip(painter, clip, fps=FPS, seconds=seconds, progress=progress)
    with progress_bar("replaying", frames) as progress:
        result = replay(
            loaded,
            str(clip),
            own_camera=True,
            events=events,
            overlay=overlay,
            realtime=pages is not None,
            mqtt=False,
            progress=progress,
            pages=pages,
            serving=print_address,
        )
    lines = [json.loads(line) for line in events.read_text(encoding="utf-8").splitlines()]
    summary = {
        **summarise(lines, scenario.name),
        "notice": NOT_FOR_STREETS if loaded.config.detection.model == BUNDLED else None,
        "config_hash": loaded.hash,
        "detector": result.detector,
        "latency_ms": result.as_dict()["latency_ms"],
    }
    text = format_summary(summary)
    write_whole(out / "summary.txt", text)
    write_json(summary, str(out / "summary.json"))
    written = (
        f"  {overlay}  detections, tracks and decisions as video",
        f"  {events}  every frame as JSON",
        f"  {clip}  the drawn fisheye video",
        f"  {out / 'summary.json'}  this summary",
    )
    report(summary, json_path, (text, *written))
