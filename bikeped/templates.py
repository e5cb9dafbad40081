"""HTML from Jinja2 templates. Every value is escaped unless it is `Markup` already."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup


def render(name: str, /, *folders: Path, **values: Any) -> Markup:
    """The template `name`, filled with `values`.

    It is taken from the first of `folders` that has it, as are the templates that it extends,
    includes or imports. Raises jinja2.TemplateNotFound when none has it, jinja2.UndefinedError
    when the template uses a value that is not given.
    """
    return Markup(_environment(folders).get_template(name).render(values))


@cache
def _environment(folders: tuple[Path, ...]) -> Environment:
    return Environment(
        loader=FileSystemLoader(folders),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        auto_reload=False,
    )
