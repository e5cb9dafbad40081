"""`--web [HOST:]PORT`: addresses as people write them; what is refused before anything starts."""

from __future__ import annotations

import re

import pytest

from bikeped.cli.common import web_overrides
from bikeped.cli.main import main
from bikeped.config.load import load_config
from bikeped.errors import BikepedError


@pytest.mark.parametrize(
    ("place", "host", "port"),
    [
        ("8080", "127.0.0.1", 8080),
        ("0", "127.0.0.1", 0),
        ("localhost:81", "localhost", 81),
        ("[::1]:82", "::1", 82),
        (" 127.0.0.2:83 ", "127.0.0.2", 83),
    ],
)
def test_addresses(small_config, place, host, port):
    web = load_config(small_config(), web_overrides(place)).config.web
    assert (web.enabled, web.host, web.port) == (True, host, port)


@pytest.mark.parametrize("place", ["", "x", ":80", "1:2:3", "::1:80", "host:", "http://h:80", "-1"])
def test_what_is_no_address_is_refused(place):
    with pytest.raises(BikepedError, match=r"--web .*127\.0\.0\.1:8080"):
        web_overrides(place)


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("0.0.0.0:0", "web.token_file"),
        ("99999", "web.port"),
        ("nonsense", "--web nonsense"),
        ("192.0.2.1:0", "web.token_file"),
    ],
)
def test_a_replay_for_everybody_is_refused_before_it_starts(
    small_config, make_clip, capsys, place, said
):
    config = small_config()
    assert main(["replay", str(make_clip("c.avi", 3)), "-c", str(config), "--web", place]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("bikeped: ")
    assert said in line


def test_a_replay_with_pages_says_where(small_config, make_clip, capsys):
    clip = make_clip("c.avi", 3)
    assert main(["replay", str(clip), "-c", str(small_config()), "--web", "0"]) == 0
    assert re.search(r"^http://127\.0\.0\.1:\d+/ shows it", capsys.readouterr().err, re.MULTILINE)


def test_an_address_that_cannot_be_bound_ends_a_replay_with_the_mend(
    small_config, make_clip, tmp_path, capsys
):
    (tmp_path / "token").write_text("a-long-enough-token\n")
    arguments = ["--set", f"web.token_file={tmp_path / 'token'}", "--web", "192.0.2.1:0"]
    clip = make_clip("c.avi", 3)
    assert main(["replay", str(clip), "-c", str(small_config()), *arguments]) == 2
    assert "set web.host and web.port" in capsys.readouterr().err
