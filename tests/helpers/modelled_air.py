"""A channel that all agents of a room share, without messages: what each reports and is granted."""

from __future__ import annotations

import numpy as np

from share.config import ControlConfig
from share.scheduling.qoe import QoeParameters
from share.scheduling.room_budget import OTHER_HZ, first_grant, message_s
from share.scheduling.room_controller import AirtimeMeasurement, RoomController
from share.types import AgentKind
from share.wire.messages import Evaluation

S = 1_000_000_000
STEP_S = 0.5
AT_ONCE_MS = 4.0  # of air that one transmission takes: what precedes a keyframe arrives with its beginning
TERMS = {kind: QoeParameters.from_config(ControlConfig(), kind) for kind in AgentKind}


class Air:
    """A channel on which a keyframe with a full picture takes `alone_ms` alone. noise: of what each measures,
    sigma of its logarithm. robots_hz: what robots want. history: rates of all agents every 0.5 s."""

    def __init__(
        self,
        alone_ms: float,
        kinds: tuple[AgentKind, ...],
        wanted_hz: float = 1.5,
        robots_hz: float | None = None,
        noise: float = 0.0,
    ) -> None:
        self.alone_ms, self._noise, self._rng = alone_ms, noise, np.random.default_rng(1)
        self.wanted_hz = {AgentKind.AR: wanted_hz, AgentKind.ROBOT: robots_hz or wanted_hz}
        self.room, self.now_s = RoomController(), 0.0
        self.kinds: list[AgentKind] = []
        self.counts: list[list[float]] = []
        self.grants = [first_grant(kind) for kind in kinds]
        self.history: list[list[float]] = []
        self.join(kinds)

    def join(self, kinds: tuple[AgentKind, ...]) -> None:
        """Let agents join at once."""
        self.grants = [*self.grants[: len(self.kinds)], *(first_grant(kind) for kind in kinds)]
        self.kinds += kinds
        self.counts += [[k / len(kinds), 0.0] for k in range(len(kinds))]  # they do not send in step

    def load(self) -> float:
        alone_s = self.alone_ms / 1e3
        messages_hz = sum(OTHER_HZ + (30.0 if g.pose_hz is None else g.pose_hz) for g in self.grants)
        keyframes_s = alone_s * sum(g.hz * g.size for g in self.grants)
        return min(0.98, keyframes_s + messages_hz * message_s(alone_s))

    def play(self, seconds: float) -> None:
        end = self.now_s + seconds
        while self.now_s < end:
            self.now_s += STEP_S
            self._report()
            self.history.append([g.hz for g in self.grants])

    def pause(self, seconds: float) -> None:
        """Let the edge hear nothing for a while; then all evaluations of that time at once, late ones."""
        began_s = self.now_s
        self.now_s += seconds
        for waited_s in range(1, int(seconds) + 1):
            self._report(1e3 * waited_s, began_s + waited_s)

    def _report(self, waited_ms: float | None = None, sent_s: float | None = None) -> None:
        full_ms = self.alone_ms / (1 - self.load())
        for k, kind in enumerate(self.kinds):
            sent, pose_hz = self.grants[k].hz, self.grants[k].pose_hz
            if sent_s is None:  # during a pause nothing arrives
                self.counts[k][0] += STEP_S * sent
                self.counts[k][1] += STEP_S * (30.0 if pose_hz is None else pose_hz)
            keyframe_ms = full_ms * self.grants[k].size if waited_ms is None else waited_ms
            air_ms = keyframe_ms * self._noisy()
            told = Evaluation(0, 60 + air_ms, 1.2, 10.0, 5.0, 5 + air_ms, 0.5)
            counts = round(self.counts[k][0]), round(self.counts[k][1])
            seen_ms = max(0.0, keyframe_ms * self._noisy() - AT_ONCE_MS)
            at = (
                f"a{k}",
                TERMS[kind],
                self.wanted_hz[kind],
                told,
                AirtimeMeasurement(air_ms, seen_ms, *counts),
            )
            self.grants[k] = self.room.grant(*at, round(self.now_s * S))

    def _noisy(self) -> float:
        return float(np.exp(self._noise * self._rng.standard_normal()))
