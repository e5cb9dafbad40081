"""The page on traffic: its data agree with the run, and a browser steps through the alerts."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect
from traffic_scenes import write_traffic
from web_fakes import PHONE

from bikeped.cli.main import main
from bikeped.config.load import load_config
from bikeped.lab.simulation.suite import CONFIGURATIONS
from bikeped.lab.testbench.traffic_page import render_traffic_page
from bikeped.lab.traffic.readers import read_traffic
from bikeped.lab.traffic.result import traffic_result
from bikeped.lab.traffic.suite import TrafficSuite
from bikeped.types import State

CONFIG = Path(__file__).parents[3] / "config.yaml"
LOADED = load_config(CONFIG)
HOSTILE = "</script><img src=x onerror=alert(1)>"
#: One street with harmless passes and one with danger.
NAMES = ("Swerving Cyclist", "Safe Crossing", "U-Turn Cyclist")


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    scenes = list(read_traffic(write_traffic(tmp_path_factory.mktemp("traffic"), NAMES)))
    scenario = replace(scenes[0].scenario, name=HOSTILE)
    scenes[0] = replace(scenes[0], scenario=scenario)
    return TrafficSuite.load(scenes, LOADED, "realistic", 1)


@pytest.fixture(scope="module")
def page_text(suite):
    rules = {"distance_only": CONFIGURATIONS["distance_only"]}
    result = traffic_result(suite, rules, LOADED)
    return render_traffic_page(suite, "distance_only", *rules.values(), result, f"run {HOSTILE}")


@pytest.fixture(scope="module")
def data(page_text):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page_text)
    assert found is not None
    return json.loads(found[1])


def test_every_alert_is_there_nuisance_first(suite, data):
    lights = suite.lights(CONFIGURATIONS["distance_only"])
    begins = {
        (i, round(begin / 30, 3)): bool(justified)
        for i, light in enumerate(lights)
        for (begin, _), justified in zip(
            light.episodes().frames.tolist(), light.episodes().justified, strict=True
        )
    }
    found = {
        (alert["scene"], round(alert["begin_s"], 3)): alert["kind"] != "nuisance"
        for alert in data["alerts"]
    }
    assert found == begins
    kinds = [alert["kind"] for alert in data["alerts"]]
    assert kinds == sorted(kinds, key=["nuisance", "conflict", "danger"].index)
    assert len(kinds) >= 2


def test_a_clip_holds_what_the_light_did(suite, data):
    lights = suite.lights(CONFIGURATIONS["distance_only"])
    for alert in data["alerts"]:
        frames = round(alert["first_s"] * 30) + 3 * np.arange(len(alert["raw"]))
        light = lights[alert["scene"]]
        assert alert["side"]["state"] == light.states[frames].tolist()
        assert alert["raw"] == light.raw[frames].tolist()
        assert alert["danger"] == light.truth.danger[frames].tolist()
        assert alert["side"]["state"][alert["onset"]] == int(State.ALERT)
        count = len(alert["raw"])
        assert len(alert["sentence"]) == len(alert["side"]["chosen"]) == count
        assert len(alert["tracks"]["start"]) == len(alert["side"]["pairs"]["start"]) == count + 1
        for agent in alert["agents"]:
            assert len(agent["true"]) == len(agent["detected"]) == 2 * count


def test_names_and_commands_are_escaped(page_text):
    assert "<img" not in page_text
    assert "&lt;img" in page_text


def test_the_alerts_are_stepped_through(page_text, data, open_page, assert_accessible, tmp_path):
    file = tmp_path / "page.html"
    file.write_text(page_text, encoding="utf-8")
    page = open_page(file.as_uri())
    page.wait_for_selector("html[data-ready=traffic]")
    alerts = data["alerts"]
    place = page.locator("#place")
    expect(place).to_have_text(f"Alert 1 of {len(alerts)}")
    expect(page.locator("#sentence")).to_have_text(alerts[0]["sentence"][alerts[0]["onset"]])
    expect(page.locator("#before")).to_be_disabled()
    page.locator("#next").click()
    expect(place).to_have_text(f"Alert 2 of {len(alerts)}")
    page.locator("#moment").fill("0")
    expect(page.locator("#sentence")).to_have_text(alerts[1]["sentence"][0])
    assert_accessible(page)
    scene = alerts[-1]["scene"]
    page.locator("#scene").select_option(str(scene))
    own = [alert for alert in alerts if alert["scene"] == scene]
    expect(place).to_have_text(f"Alert 1 of {len(own)}")
    assert page.locator("#alerts button").count() == len(own)
    page.locator("#play").click()
    expect(page.locator("#play")).to_have_text("Pause")


def test_it_fits_a_phone(page_text, open_page, tmp_path):
    file = tmp_path / "page.html"
    file.write_text(page_text, encoding="utf-8")
    page = open_page(file.as_uri(), viewport=PHONE, scheme="dark")
    page.wait_for_selector("html[data-ready=traffic]")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_the_command_writes_it(tmp_path):
    street = tmp_path / "street"
    street.mkdir()
    write_traffic(street)
    out = tmp_path / "page.html"
    words = ["conformance", "traffic", str(street), "-c", str(CONFIG), "--html", str(out)]
    assert main(words) == 0
    text = out.read_text(encoding="utf-8")
    assert "the rule <strong>configured</strong>" in text
    assert main([*words[:-1], str(street / "poles.json")]) == 2
