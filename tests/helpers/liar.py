"""An edge that says whatever the wire lets it say."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from helpers.hellos import hello_of

from share.checks import MAX_ID, MAX_POSITION_M, MAX_STAMP_NS
from share.geometry import se3
from share.types import Correction, Keyframe, TrackState
from share.wire import messages as m
from share.wire.codec import encode

S = 1_000_000_000
HELLO = hello_of("ann", 5, focal=460.0)
IDS = (0, 1, 2, 5, 40, 1000, MAX_ID - 1, MAX_ID)
STAMPS = (0, 1, -1, S, -MAX_STAMP_NS, MAX_STAMP_NS, 9 * 10**17)


@dataclass
class Liar:
    """Makes messages that are valid, and absurd. It knows the pings and keyframes that it was sent."""

    rng: np.random.Generator
    pings: list[m.Ping] = field(default_factory=list)
    sent: int = 0
    before: list[list[bytes]] = field(default_factory=list)

    def hear(self, message: m.Message) -> None:
        if isinstance(message, m.Ping):
            self.pings.append(message)
        if isinstance(message, Keyframe):
            self.sent = max(self.sent, message.id + 1)

    def say(self) -> list[bytes]:
        kind = self._pick(*self._kinds())
        frames = [bytes(frame) for frame in encode(kind())] if callable(kind) else kind
        if self.before and self.rng.random() < 0.1:  # again, later
            frames = self._pick(*self.before[-50:])
        if self.rng.random() < 0.1:
            frames = self._spoiled(frames)
        self.before = [*self.before[-200:], frames]
        return frames

    def _kinds(self) -> Iterator[Callable[[], m.Message]]:
        id_ = lambda least=0: self._pick(*IDS, *range(least, max(1, self.sent)))  # noqa: E731
        session = lambda: self._pick(1, 2, 3, int(self.rng.integers(2**62)))  # noqa: E731
        yield lambda: m.Welcome(session(), id_(), self._pick(0.0, 0.0, m.MAX_HOLD_MS))
        yield lambda: m.Refused(self._pick("", "no", "\x1b[2J\r\n", "x" * m.MAX_TEXT_LENGTH))
        yield lambda: m.Ack(id_(), tuple(id_() for _ in range(self._pick(0, 1, 256))))
        yield lambda: Correction(self._pose(), self._cov(), self._map(), id_(), id_(), self._pick(-1, id_()))
        yield lambda: m.Rate(self._pick(0.0, 1e-300, 1e-3, m.MAX_RATE_HZ))
        yield self._pong
        yield lambda: m.RemoteTrackingResult(
            id_(), self._pick(*STAMPS), TrackState.OK, self._pose(), True, True
        )
        yield lambda: m.RemoteTrackingResult(id_(), 0, TrackState.LOST, None)
        yield lambda: m.Bye()
        yield lambda: HELLO

    def _pong(self) -> m.Message:
        ping = self._pick(*self.pings) if self.pings else m.Ping(1, 1)
        received, replied = self._pick(*STAMPS), self._pick(*STAMPS)
        if self.rng.random() < 0.5:
            replied = received
        return m.Pong(ping.sequence, ping.sent_ns, received, replied, self._pick(1, 2, 3))

    def _pose(self) -> np.ndarray:
        far = self._pick(0.0, 1.0, MAX_POSITION_M, -MAX_POSITION_M) * np.ones(3)
        T = se3.from_rt(se3.so3_exp(self.rng.uniform(-4, 4, 3)), far)
        T[:3, :3] *= self._pick(1.0, 1.0004)  # as far from rigid as may be
        return T

    def _cov(self) -> np.ndarray:
        A = self.rng.normal(size=(6, 6)) * self._pick(0.0, 1e-9, 1.0, 1e5)
        return A @ A.T

    def _map(self) -> str:
        return self._pick("a", "b", "m" * 96, f"{self.rng.integers(10**9)}")

    def _spoiled(self, frames: list[bytes]) -> list[bytes]:
        at = int(self.rng.integers(len(frames)))
        frame = bytearray(frames[at])
        for _ in range(self._pick(1, 3)):
            if frame:
                frame[int(self.rng.integers(len(frame)))] = int(self.rng.integers(256))
        return [*frames[:at], bytes(frame), *frames[at + 1 :]][: self._pick(1, len(frames), 99)]

    def _pick(self, *choices: Any) -> Any:
        return choices[int(self.rng.integers(len(choices)))]
