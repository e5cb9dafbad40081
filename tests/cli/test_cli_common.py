"""What all commands share: the progress bar on a terminal."""

from __future__ import annotations

import io

from rich.console import Console

from bikeped.cli import common


def test_a_progress_bar_shows_the_count_on_a_terminal_only(monkeypatch):
    text = io.StringIO()
    terminal = Console(file=text, force_terminal=True, width=100)
    monkeypatch.setattr(common, "console", lambda json_path=None: terminal)
    with common.progress_bar("trials", 4) as advance:
        advance(3)
    assert "trials" in text.getvalue()
    assert "3/4" in text.getvalue()
    plain = io.StringIO()
    monkeypatch.setattr(common, "console", lambda json_path=None: Console(file=plain))
    with common.progress_bar("trials", 4) as advance:
        advance(3)
    assert plain.getvalue() == ""
