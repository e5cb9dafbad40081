"""`/testbench`: the simulation behind a page. The page draws; every number is computed here, by the
deployed rule and the conformance code.

A request is JSON: the whole `BenchSettings` and an identifier of the browser page. Of each kind (a
scenario, the suite, its trials) one answer is computed at a time, in a thread: a slider does not
wait for the suite. Of a page's waiting requests only the newest is answered (the others get
status 409); when too many pages wait, the answer is status 503.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from aiohttp import web
from msgspec import Meta

from bikeped import __version__
from bikeped.config.json_schema import key_descriptions
from bikeped.config.load import LoadedConfig
from bikeped.config.output_sections import Section
from bikeped.config.provenance import DECIDING_CODE, code_hash
from bikeped.config.schema import DecisionConfig
from bikeped.lab.experiments.optimizer import BOUNDS
from bikeped.lab.scenarios.scenario import HAZARDS, SIZES_M, Scenario, dump_scenario
from bikeped.lab.simulation.suite import CONFIGURATIONS
from bikeped.lab.testbench.comparison import InvocationOptions, comparison_json
from bikeped.lab.testbench.playback import TESTS, TIERS, coverage, playback
from bikeped.lab.testbench.runner import BenchRunner, trial_summaries
from bikeped.lab.testbench.settings import (
    MAX_SCRIPT_CHARS,
    BenchSettings,
    check_settings,
    parse_custom_scenario,
    settings_from_file,
    settings_from_link,
    settings_in_force,
    settings_to_link,
)
from bikeped.web.server import Page, add_page, json_answer, json_body

T = TypeVar("T")

_MOST_WAITING = 16
_FILES = ("testbench.html", ("testbench.js",), ("testbench.css",), Path(__file__).parent)
PAGE = Page("/testbench", "Test bench", "Test bench", *_FILES)


class BenchRequest(Section, frozen=True):
    """A request to run with these settings; `client` identifies the browser page."""

    bench: BenchSettings
    client: Annotated[str, Meta(max_length=40)] = ""


class TextRequest(Section, frozen=True):
    """An uploaded text: a scenario file, saved settings, or a link."""

    text: Annotated[str, Meta(max_length=900_000)]
    name: Annotated[str, Meta(max_length=120)] = "file"


def add_testbench(
    app: web.Application,
    loaded: LoadedConfig,
    scenarios: Sequence[Scenario],
    origin: InvocationOptions = InvocationOptions(),  # noqa: B008 - immutable
) -> None:
    """Adds the page and its API; `loaded` is the configuration in force, `scenarios` the suite."""
    # A runner for the scenario shown and one for the suite: neither waits for the other's lock.
    shown, work = BenchRunner(loaded, scenarios), BenchRunner(loaded, scenarios)
    named = configurations(loaded)
    description = msgspec.json.encode(page_description(work, named))
    base = settings_in_force(loaded)

    def add_job(path: str, compute: Callable[[BenchSettings], Any]) -> None:
        """A route that computes an answer from settings, with a queue of its own."""
        queue = JobQueue()

        async def run(request: web.Request) -> web.Response:
            body = await json_body(request, BenchRequest)
            check_settings(body.bench)
            answer = await queue.run(body.client, lambda: msgspec.json.encode(compute(body.bench)))
            return web.Response(body=answer, content_type="application/json")

        app.router.add_post(path, run)

    async def about(_request: web.Request) -> web.Response:
        return web.Response(body=description, content_type="application/json")

    async def read_scenario(request: web.Request) -> web.Response:
        body = await json_body(request, TextRequest)
        if len(body.text) > MAX_SCRIPT_CHARS:
            raise web.HTTPRequestEntityTooLarge(MAX_SCRIPT_CHARS, len(body.text))
        scenario = await asyncio.to_thread(parse_custom_scenario, body.text, body.name)
        return json_answer({"script": script(scenario), "text": dump_scenario(scenario)})

    async def read_challenge(request: web.Request) -> web.Response:
        body = await json_body(request, TextRequest)
        if body.text.lstrip().startswith("{"):
            bench = settings_from_file(body.text, body.name)
        else:
            bench = settings_from_link(body.text, base)
        return json_answer({"bench": bench, "link": settings_to_link(bench, base)})

    add_page(app, PAGE)
    app.router.add_get("/testbench/about", about)
    add_job("/testbench/scenario", lambda bench: scenario_json(shown, bench, named))
    add_job("/testbench/suite", lambda bench: comparison_json(work, bench, origin))
    add_job("/testbench/trials", lambda bench: trials_json(work, bench))
    app.router.add_post("/testbench/read-scenario", read_scenario)
    app.router.add_post("/testbench/read-challenge", read_challenge)


def configurations(loaded: LoadedConfig) -> dict[str, DecisionConfig]:
    """The named configurations, and the one in force where it is none of them."""
    if loaded.config.decision in CONFIGURATIONS.values():
        return dict(CONFIGURATIONS)
    return {"configured": loaded.config.decision, **CONFIGURATIONS}


def scenario_json(
    work: BenchRunner, bench: BenchSettings, named: dict[str, DecisionConfig]
) -> dict[str, Any]:
    """The playback of the scenario shown, under the bench's decision and those beside it."""
    suite = work.shown_suite(bench)
    name = next((n for n, d in named.items() if d == bench.decision), "bench")
    sides = {name: bench.decision, **{n: named[n] for n in bench.beside if n in named}}
    return {
        **playback(suite, 0, sides),
        "cameras": [coverage(suite.camera, pose) for pose in suite.poses],
        "link": settings_to_link(bench, settings_in_force(work.loaded)),
        "script": script(suite.scenarios[0]),
    }


def trials_json(work: BenchRunner, bench: BenchSettings) -> dict[str, Any]:
    """Means over the random trials of the suite; `trials` is null when nobody is missed."""
    return {"trials": trial_summaries(work.full_suite(bench), bench)}


def script(scenario: Scenario) -> dict[str, Any]:
    """A scenario as the editor holds it."""
    agents: list[dict[str, Any]] = []
    for agent in scenario.agents:
        agents.append({"id": agent.id, "kind": agent.kind, "path": agent.path.tolist()})
        if agent.size_m != SIZES_M[agent.kind]:
            size = zip(("length", "width", "height"), agent.size_m, strict=True)
            agents[-1]["size"] = dict(size)
        if agent.hidden:
            agents[-1]["hidden"] = [list(span) for span in agent.hidden]
    keys = ("name", "hazard", "expected", "vehicle", "story")
    held: dict[str, Any] = {key: getattr(scenario, key) for key in keys}
    if scenario.length_s is not None:
        held["duration_s"] = scenario.length_s
    return {**held, "agents": agents}


def page_description(work: BenchRunner, named: dict[str, DecisionConfig]) -> dict[str, Any]:
    """What the page loads once: scenarios, configurations, ranges and code hashes."""
    base = settings_in_force(work.loaded)
    return {
        "version": __version__,
        "rule_hash": code_hash(DECIDING_CODE),
        "suite_hash": work.full_suite(base).hash,
        "config_hash": work.loaded.hash,
        "base": base,
        "link": settings_to_link(base, base),
        "configurations": named,
        "in_force": next(n for n, d in named.items() if d == base.decision),
        "tests": list(TESTS),
        "tiers": TIERS,
        "hazards": HAZARDS,
        "kinds": SIZES_M,
        "search": {b.key: [b.low, b.high] for b in BOUNDS},
        "ranges": ranges(),
        "scenarios": [
            {
                **{key: getattr(s, key) for key in ("name", "hazard", "story", "duration_s")},
                "agents": len(s.agents),
            }
            for s in work.scenarios
        ],
    }


def ranges() -> dict[str, Any]:
    """Bounds and meaning of every setting by key, as `BenchSettings` checks them."""
    found: dict[str, Any] = {}
    for section in msgspec.structs.fields(BenchSettings):
        if not (isinstance(section.type, type) and issubclass(section.type, Section)):
            continue
        schema = msgspec.json.schema(section.type)["$defs"][section.type.__name__]
        kinds = section.type.__mro__[: section.type.__mro__.index(Section)]
        meanings = {key: text for kind in kinds for key, text in key_descriptions(kind).items()}
        for key, value in schema["properties"].items():
            found[f"{section.name}.{key}"] = {
                "low": value.get("minimum", value.get("exclusiveMinimum")),
                "high": value.get("maximum"),
                "meaning": meanings.get(key, ""),
                "whole": value.get("type") == "integer",
            }
    return found


class JobQueue:
    """Runs one job at a time, in a thread; of each client's waiting jobs only the newest."""

    def __init__(self, most_waiting: int = _MOST_WAITING) -> None:
        self._most = most_waiting
        self._waiting: OrderedDict[str, asyncio.Future[bool]] = OrderedDict()
        self._busy = False

    async def run(self, client: str, job: Callable[[], T]) -> T:
        """The job's result. HTTPConflict when a newer job of this client replaced it,
        HTTPServiceUnavailable when too many jobs wait."""
        if self._busy:
            await self._wait(client)
        self._busy = True
        task = asyncio.ensure_future(asyncio.to_thread(job))
        # Shielded: when a client disconnects, the next job still waits for the running one.
        task.add_done_callback(lambda _: self._next())
        return await asyncio.shield(task)

    async def _wait(self, client: str) -> None:
        old = self._waiting.pop(client, None)
        if old is not None and not old.done():
            old.set_result(False)
        if len(self._waiting) >= self._most:
            raise web.HTTPServiceUnavailable(
                text="Too many runs are waiting: try again in a few seconds.",
                headers={"Retry-After": "3"},
            )
        turn: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        self._waiting[client] = turn
        try:
            mine = await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled() and turn.result():
                self._next()  # the client left as its turn came: pass it on
            elif self._waiting.get(client) is turn:
                del self._waiting[client]
            raise
        if not mine:
            raise web.HTTPConflict(text="A newer request of this page took its place.")

    def _next(self) -> None:
        self._busy = False
        while self._waiting:
            _, turn = self._waiting.popitem(last=False)
            if not turn.done():
                self._busy = True  # reserved for this job
                turn.set_result(True)
                return
