"""`python -m bikeped.feedback`: darkening the light of a service that has ended."""

from __future__ import annotations

from pathlib import Path

import pytest

import bikeped.feedback.__main__ as darken
from bikeped.config.output_sections import FeedbackConfig
from bikeped.errors import FeedbackError


class Light:
    def __init__(self) -> None:
        self.closed = False

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "config.yaml"
    # A mistake in another section must not keep a light on.
    path.write_text("feedback: {light: gpio, gpio: {red: 5}}\ncamera: {wrong: 1}\n")
    return path


def test_opens_the_configured_light_and_closes_it(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    light, asked = Light(), []

    def open_light(feedback: FeedbackConfig) -> Light:
        asked.append(feedback.gpio.red)
        return light

    monkeypatch.setattr(darken, "open_light", open_light)
    assert darken.main([str(config)]) == 0
    assert asked == [5]
    assert light.closed


def test_a_light_out_of_reach_is_one_line_and_status_2(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def open_light(feedback: FeedbackConfig) -> Light:
        raise FeedbackError("feedback.gpio: no chip")

    monkeypatch.setattr(darken, "open_light", open_light)
    assert darken.main([str(config)]) == 2
    assert capsys.readouterr().err == "feedback.gpio: no chip\n"


def test_a_malformed_file_is_one_line_and_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for text in ("feedback: {light: candle}\n", "feedback: [\n", "7\n"):
        (tmp_path / "bad.yaml").write_text(text)
        assert darken.main([str(tmp_path / "bad.yaml")]) == 2
        assert "bad.yaml: " in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["a", "b"], ["/nowhere/config.yaml"]])
def test_bad_arguments_end_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert darken.main(arguments) == 2
    assert capsys.readouterr().err.count("\n") == 1
