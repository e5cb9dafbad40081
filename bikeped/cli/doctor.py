"""`bikeped doctor`: checks of the installation, each with a remedy."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click
from rich.text import Text

from bikeped.cli.common import config_options, console, json_option, text_table, write_json
from bikeped.cli.guard import guarded
from bikeped.config.load import default_config_path, load_config
from bikeped.errors import BikepedError
from bikeped.pipeline.doctor import Finding, checks, run_checks
from bikeped.pipeline.single_instance import holder

_STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red", "skipped": "dim"}


@click.command("doctor")
@config_options
@click.option("--no-light", is_flag=True, help="Do not switch the lamps: road users see them.")
@click.option("--no-sound", is_flag=True, help="Do not play the chime.")
@json_option
@guarded
def command(
    config_path: Path | None,
    overrides: tuple[str, ...],
    no_light: bool,
    no_sound: bool,
    json_path: str | None,
) -> int:
    """Check camera, model, light, speaker, broker, clock and disk; 1 when one of them fails."""
    file = config_path or default_config_path()
    findings: list[Finding] = []
    try:
        loaded = load_config(config_path, overrides)
    except BikepedError as error:
        if not file.is_file() or overrides:
            raise  # the command line is wrong, not the installation
        findings.append(Finding("fail", str(error), "the other checks need it", "configuration"))
    else:
        todo = checks(light=not no_light, sound=not no_sound, beside=holder(loaded))
        with console("-").status("checking") as status:  # on standard error
            for finding in run_checks(loaded, todo):
                findings.append(finding)
                status.update(f"checking, {finding.name} done")
    failed = any(finding.status == "fail" for finding in findings)
    report = {
        "ok": not failed,
        "source": str(file),
        # `mend` is the older name of `remedy`; readers of the report may use it.
        "checks": [{**dataclasses.asdict(f), "mend": f.remedy} for f in findings],
    }
    if json_path is not None:
        write_json(report, json_path)
    if json_path != "-":
        _print(findings)
    return int(failed)


def _print(findings: list[Finding]) -> None:
    rows = []
    for f in findings:
        remedy = f"\n-> {f.remedy}" if f.remedy else ""
        rows.append((Text(f.status, _STYLES[f.status]), f.name, f.detail + remedy))
    console().print(text_table(("", "", ""), rows, align="lll"))
