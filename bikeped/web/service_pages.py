"""The pages of a running service: live view and alignment, with the monitoring beside them."""

from __future__ import annotations

from functools import partial

import msgspec
from aiohttp import web

from bikeped.config.load import LoadedConfig
from bikeped.pipeline.application import WebContext
from bikeped.pipeline.loop import FrameResult
from bikeped.telemetry.http_server import add_monitoring, limit_rate
from bikeped.types import Decision, Frame, Signal
from bikeped.web.align import add_align
from bikeped.web.live import LivePage, add_live
from bikeped.web.live_state import LiveState
from bikeped.web.security import load_access_policy
from bikeped.web.server import make_application


class ServicePages:
    """What `bikeped run` and `bikeped replay --web` serve.

    Raises ConfigError when the configuration would let others in without a token.
    """

    def __init__(self, loaded: LoadedConfig) -> None:
        self._access = load_access_policy(loaded.config.web, loaded.base_dir, loaded.source)
        self.state = LiveState()

    async def on_frame_result(self, result: FrameResult) -> None:
        await self.state.on_frame_result(result)

    def on_signal(self, signal: Signal, sentence: str, decision: Decision | None) -> None:
        self.state.on_signal(signal, sentence, decision)

    def application(self, web_context: WebContext) -> web.Application:
        app = make_application(
            self._access,
            partial(add_live, live=LivePage(self.state, web_context)),
            partial(add_align, loaded=web_context.loaded, frame=self.newest),
        )
        limit_rate(app)
        add_monitoring(app, web_context.metrics, lambda: msgspec.to_builtins(web_context.health()))
        return app

    def newest(self) -> Frame | None:
        """The newest frame with a decision."""
        return None if self.state.result is None else self.state.result.decoded.frame
