"""Settings travel as links and files without loss; what is wrong is refused, in words."""

import asyncio
import contextlib
import io
import json
import threading

import msgspec
import pytest
from aiohttp import web
from aiohttp.test_utils import TestClient, TestServer
from hypothesis import given, settings
from hypothesis import strategies as st
from testbench_fakes import BASE, MARKUP, OWN, bench, pages

from bikeped.config.json_schema import key_descriptions
from bikeped.config.schema import DecisionConfig
from bikeped.errors import BikepedError, ScenarioError
from bikeped.lab.testbench.pages import JobQueue, ranges
from bikeped.lab.testbench.settings import (
    BenchSettings,
    Delay,
    GroundTruthThresholds,
    Mount,
    Perception,
    Pose,
    custom_scenarios,
    parse_custom_scenario,
    settings_from_file,
    settings_from_link,
    settings_to_file,
    settings_to_link,
)


def number(low, high):
    return st.floats(low, high, allow_nan=False)


poses = {"x_m": number(-100, 100), "y_m": number(-100, 100), "heading_deg": number(-360, 360)}
benches = st.builds(
    BenchSettings,
    camera=st.builds(
        Mount, height_m=number(1, 15), pitch_deg=number(-90, 30), fov_deg=number(30, 240), **poses
    ),
    decision=st.builds(
        DecisionConfig,
        rule=st.sampled_from(["pairwise", "naive", "ttc", "distance"]),
        memory_frames=st.integers(0, 120),
        d_min_m=number(0, 5),
        d_max_m=number(5, 30),
        min_displacement_m=number(0, 1),
        speed_adaptive=st.booleans(),
    ),
    perception=st.builds(
        Perception,
        localisation_error=st.booleans(),
        recall=st.sampled_from(["all", "size", "kind", "fixed"]),
        burst_frames=st.none() | number(1, 50),
        seed=st.integers(0, 2**31),
    ),
    delay=st.builds(Delay, delay_ms=number(0, 1000), order=st.sampled_from([0, 1, 2])),
    danger=st.builds(
        GroundTruthThresholds,
        cpa_radius_m=number(0.1, 25),
        ttc_bound_s=st.none() | number(0.1, 60),
        braking=st.sampled_from([None, "bicycle", "ebike", "aashto"]),
    ),
    second_camera=st.none() | st.builds(Pose, **poses),
    scenario=st.text(st.characters(exclude_categories=["Cs"]), max_size=30),
    beside=st.lists(st.sampled_from(["ttc", "narrow"]), max_size=2).map(tuple),
    scripts=st.lists(st.just(OWN), max_size=1).map(tuple),
)


@settings(max_examples=60, deadline=None)
@given(benches)
def test_a_bench_travels_as_link_and_file_without_loss(one):
    link = settings_to_link(one, BASE)
    assert settings_from_link(link, BASE) == one
    assert settings_from_link(f"http://127.0.0.1:8090/testbench#{link}", BASE) == one
    assert (
        settings_from_file(settings_to_file(one, BASE, {"version": "1"}), "challenge.json") == one
    )


def test_nothing_changed_is_an_empty_link():
    assert settings_to_link(BASE, BASE) == ""
    assert settings_from_link("", BASE) == BASE
    assert settings_to_link(bench(decision={"d_max_m": 15.0}), BASE) == "decision.d_max_m=15.0"


@settings(max_examples=200, deadline=None)
@given(st.text(st.sampled_from('decision.mx_=&%#1"{}[]\\ecamrNa∞'), max_size=60))
def test_any_text_is_a_bench_or_an_error_in_words(text):
    with contextlib.suppress(BikepedError):  # and nothing else
        assert isinstance(settings_from_link(text, BASE), BenchSettings)


@pytest.mark.parametrize(
    ("link", "says"),
    [
        ("decision.d_maxx_m=3", "there is no such setting"),
        ("nothing", "key=value"),
        ("decision.d_max_m=-1", "d_max_m"),
        ("decision.d_max_m=NaN", "d_max_m"),
        ("decision.d_max_m=1e999", "d_max_m"),
        ("decision.rule=guess", "rule"),
        ("decision.d_min_m=20&decision.d_max_m=9", "exchange"),
        ("perception.burst_frames=0", "burst_frames"),
        ("perception.trials=100000", "trials"),
        ("camera.height_m=1000", "height_m"),
        ("__class__.x=1", "there is no such setting"),
        ('beside=["a","b","c"]', "beside"),
    ],
)
def test_a_bad_link_names_what_is_wrong(link, says):
    with pytest.raises(BikepedError, match=says):
        settings_from_link(link, BASE)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 2, "bench": {}}', "{" * 100_000])
def test_a_file_that_is_no_challenge_is_refused(text):
    with pytest.raises(BikepedError, match=r"some\.json"):
        settings_from_file(text, "some.json")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name: A\nagents: []", "agents"),
        ("name: A\nagents:\n  - {id: 1, kind: dragon, path: [[0, 0, 0], [1, 0, 0]]}", "kind"),
        ("name: A\nagents:\n  - {id: 1, kind: car, path: [[0, 0, 0], [0, 1, 0]]}", "is not after"),
        ("name: A\nagents:\n  - {id: 1, kind: car, path: [[0, 0, 0], [900, 1, 0]]}", "lasts"),
        ("name: A\nagents:\n  - {id: 1, kind: car, path: [[0, 0, 0], [9, 5000, 0]]}", "away"),
        (
            "name: A\nagents:\n"
            + "".join(
                f"  - {{id: {i}, kind: car, path: [[0, {i}, 0], [1, {i}, 1]]}}\n" for i in range(41)
            ),
            "too many",
        ),
    ],
)
def test_a_bad_scenario_is_refused_in_words(text, says):
    with pytest.raises(ScenarioError, match=says):
        parse_custom_scenario(text, "scenario")


def test_two_scenarios_of_one_name_are_refused():
    with pytest.raises(ScenarioError, match="twice"):
        custom_scenarios(msgspec.structs.replace(BASE, scripts=(OWN, OWN)), parse_custom_scenario)


def test_the_page_s_ranges_are_those_that_are_checked():
    told = ranges()
    assert told["decision.memory_frames"] == {
        "low": 0,
        "high": 3000,
        "meaning": key_descriptions(DecisionConfig)["memory_frames"],
        "whole": True,
    }
    for key, one in told.items():
        if one["high"] is not None:
            with pytest.raises(BikepedError):
                settings_from_link(f"{key}={one['high'] + 1}", BASE)


async def test_requests_that_are_wrong_are_refused_and_touch_no_file():
    async with TestClient(TestServer(pages())) as client:

        async def status(path, data, **more):
            answer = await client.post(f"/testbench/{path}", data=data, **more)
            return answer.status, await answer.text()

        kind = {"headers": {"Content-Type": "application/json"}}
        whole = msgspec.to_builtins(BASE)
        assert (await status("scenario", b"{", **kind))[0] == 400
        assert (await status("scenario", b"{}", **kind))[0] == 400
        assert (await status("scenario", json.dumps({"bench": whole}).encode()))[0] == 415
        assert (await status("scenario", io.BytesIO(b"x" * 1_100_000), **kind))[0] == 413
        for name in ("../../../../etc/passwd", "/etc/passwd", "\x00", MARKUP):
            asked = json.dumps({"bench": {**whole, "scenario": name}}).encode()
            code, text = await status("scenario", asked, **kind)
            assert code == 400
            assert "does not exist" in text
            assert "root:" not in text
        extra = json.dumps({"bench": {**whole, "folder": "/etc"}}).encode()
        assert (await status("scenario", extra, **kind))[0] == 400
        wide = {**whole, "decision": {**whole["decision"], "d_max_m": 1e9}}
        code, text = await status("suite", json.dumps({"bench": wide}).encode(), **kind)
        assert (code, "d_max_m" in text) == (400, True)
        long_text = json.dumps({"text": "name: A\n" + "#" * 70_000}).encode()
        assert (await status("read-scenario", long_text, **kind))[0] == 413
        for path in ("/testbench/../config.yaml", "/testbench/%2e%2e/config.yaml"):
            assert (await client.get(path)).status == 404


async def test_too_much_work_is_refused():
    agents = [{"id": i, "kind": "pedestrian", "path": [[0, i, 0], [119, i, 9]]} for i in range(40)]
    scripts = [json.dumps({"name": f"crowd {k}", "agents": agents}) for k in range(20)]
    async with TestClient(TestServer(pages())) as client:
        asked = {**msgspec.to_builtins(BASE), "scripts": scripts}
        answer = await client.post("/testbench/suite", json={"bench": asked})
        assert answer.status == 400
        assert "more than the page computes" in await answer.text()


async def test_of_a_page_s_waiting_requests_only_the_newest_is_answered():
    queue, gate, order = JobQueue(), threading.Event(), []

    def job(name):
        def run():
            gate.wait(30)
            order.append(name)
            return name

        return run

    first = asyncio.ensure_future(queue.run("me", job("first")))
    await asyncio.sleep(0)
    old = asyncio.ensure_future(queue.run("me", job("old")))
    await asyncio.sleep(0)
    other = asyncio.ensure_future(queue.run("you", job("other")))
    await asyncio.sleep(0)
    new = asyncio.ensure_future(queue.run("me", job("new")))
    with pytest.raises(web.HTTPConflict):
        await old
    gate.set()
    assert await asyncio.gather(first, other, new) == ["first", "other", "new"]
    assert order == ["first", "other", "new"]
    assert await queue.run("me", job("later")) == "later"


async def test_a_full_queue_turns_away_and_goes_on_when_a_client_left():
    queue, gate = JobQueue(most_waiting=2), threading.Event()
    running = asyncio.ensure_future(queue.run("0", lambda: gate.wait(30)))
    await asyncio.sleep(0)
    waiting = [asyncio.ensure_future(queue.run(str(i), lambda i=i: i)) for i in (1, 2)]
    await asyncio.sleep(0)
    with pytest.raises(web.HTTPServiceUnavailable):
        await queue.run("3", lambda: 3)
    waiting[0].cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting[0]
    gate.set()
    assert await running
    assert await waiting[1] == 2


async def test_an_error_in_a_job_does_not_block_the_queue():
    queue = JobQueue()
    with pytest.raises(ZeroDivisionError):
        await queue.run("me", lambda: 1 // 0)
    assert await queue.run("me", lambda: 7) == 7
