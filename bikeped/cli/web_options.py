"""`--web [HOST:]PORT`: the live page of a replay while it runs."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bikeped.config import LoadedConfig
from bikeped.errors import BikepedError

if TYPE_CHECKING:
    from bikeped.web.service_pages import ServicePages

F = TypeVar("F", bound=Callable[..., Any])

_PLACE = re.compile(r"(?:(?P<host>\[[^\]]+\]|[^:\[\]]+):)?(?P<port>\d{1,5})")


def web_option(command: F) -> F:
    """Adds `--web`; the parameter is `web_place`."""
    return click.option(
        "--web",
        "web_place",
        metavar="[HOST:]PORT",
        help="Serve the live page meanwhile, at the recording's frame rate; e.g. 8080.",
    )(command)


def web_overrides(place: str) -> tuple[str, ...]:
    """The value of `--web` as configuration overrides; BikepedError when it is no address."""
    found = _PLACE.fullmatch(place.strip())
    if found is None:
        raise BikepedError(f"--web {place}: is not [HOST:]PORT; give e.g. 8080 or 127.0.0.1:8080")
    host = (found["host"] or "127.0.0.1").strip("[]")
    return ("web.enabled=true", f"web.host={host!r}", f"web.port={int(found['port'])}")


def print_address(address: str) -> None:
    """Prints on standard error where the page is."""
    click.echo(f"{address} shows it while it runs", err=True)


def open_pages(loaded: LoadedConfig) -> ServicePages:
    """The pages of a service or a replay; imports the web only now.

    ConfigError when others could reach them without a token.
    """
    from bikeped.web.service_pages import ServicePages

    return ServicePages(loaded)
