"""Sends one signal to the light, the speaker and all listeners."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Protocol

from bikeped.faults import Fault, fault_texts
from bikeped.feedback.light import LightOutput
from bikeped.feedback.signal_logic import OFF, SignalLogic
from bikeped.feedback.speaker import Speaker
from bikeped.pipeline.runtime import RateLimitedLogger
from bikeped.types import Decision, Signal

log = logging.getLogger(__name__)

STOPPED = "OFF: the service was stopped."


class SignalListener(Protocol):
    """Takes every signal."""

    def on_signal(self, signal: Signal, sentence: str, decision: Decision | None) -> None:
        """What the light shows now, why, and the newest decision; with every frame and every tick.

        Must not block.
        """


class SignalDispatcher:
    """Lets `logic` choose the signal and sends it on, to the light first."""

    def __init__(
        self,
        logic: SignalLogic,
        light: LightOutput | None = None,
        speaker: Speaker | None = None,
        listeners: Sequence[SignalListener] = (),
    ) -> None:
        self._logic, self._light, self._speaker = logic, light, speaker
        self._listeners = tuple(listeners)
        self._decision: Decision | None = None
        self._limited_log = RateLimitedLogger(log)
        self.shown: Signal | None = None

    def dispatch(
        self, now_s: float, decision: Decision | None, faults: tuple[Fault, ...] = ()
    ) -> Signal:
        """Shows what `decision` (None: no new one) and `faults` lead to at `now_s`."""
        if decision is not None:
            self._decision = decision
        decided, held = (None, False) if decision is None else (decision.state, decision.held)
        signal = self._logic.next_signal(now_s, decided, faults, held)
        if signal.name == "FAULT" or self._decision is None:
            self._send(signal, "; ".join(fault_texts(signal.faults)))
        else:
            self._send(signal, self._decision.sentence)
        return signal

    def switch_off(self) -> None:
        """Darkens the light: the crossing is no longer watched."""
        self._send(OFF, STOPPED)

    def refresh(self) -> None:
        """Shows the same signal again, so that the light's watchdog does not trip."""
        if self._light is not None and self.shown is not None:
            self._light.show(self.shown)

    def _send(self, signal: Signal, sentence: str) -> None:
        if self._light is not None:
            self._light.show(signal)
        if self._speaker is not None:
            self._speaker.play(signal.sound)
        if self.shown is None or self.shown.name != signal.name:
            known = sentence.startswith(f"{signal.name}:")
            # FAULT carries its causes; an ALERT beside a fault is not logged as one.
            causes = signal.faults if signal.name == "FAULT" else ()
            level = max((fault.kind.severity for fault in causes), default=logging.INFO)
            log.log(level, "%s", sentence if known else f"{signal.name}: {sentence}")
        self.shown = signal
        for listener in self._listeners:
            self._send_to(listener, signal, sentence)

    def _send_to(self, listener: SignalListener, signal: Signal, sentence: str) -> None:
        try:
            listener.on_signal(signal, sentence, self._decision)
        except Exception as error:  # noqa: BLE001 - telemetry must not darken the light
            self._limited_log.failure("listener", error)
