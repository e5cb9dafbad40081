from pathlib import Path

import pytest
from jinja2 import TemplateNotFound, UndefinedError

from bikeped.templates import render


def test_values_are_escaped_and_rendered_parts_are_not_escaped_again(tmp_path: Path) -> None:
    (tmp_path / "part.html").write_text("<b>{{ name }}</b>")
    (tmp_path / "page.html").write_text('<p title="{{ name }}">{{ part }}</p>\n')
    part = render("part.html", tmp_path, name="<i>")
    assert part == "<b>&lt;i&gt;</b>"
    page = render("page.html", tmp_path, name='"&', part=part)
    assert page == '<p title="&#34;&amp;"><b>&lt;i&gt;</b></p>\n'


def test_the_first_folder_that_has_a_template_gives_it(tmp_path: Path) -> None:
    own, shared = tmp_path / "own", tmp_path / "shared"
    for folder in (own, shared):
        folder.mkdir()
        (folder / "part.html").write_text(folder.name)
    (shared / "page.html").write_text('{% include "part.html" %}')
    assert render("page.html", own, shared) == "own"
    assert render("page.html", shared) == "shared"


def test_a_missing_template_and_a_missing_value_are_errors(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("{{ title }}")
    with pytest.raises(TemplateNotFound):
        render("other.html", tmp_path)
    with pytest.raises(UndefinedError, match="title"):
        render("page.html", tmp_path)
