"""The edge's clock as seen from the agent: offset, drift and round trip, from ping and pong."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from share.config import ClockConfig
from share.core.exchange import Exchange
from share.core.rate import SECOND_NS
from share.types import F64

_SMOOTHING = 1 / 8  # RFC 6298, section 2
MOST_APART_NS = 10 * 365 * 86_400 * SECOND_NS  # clocks that begin at start-up: no machine is up for longer
_WITNESSES = 3  # exchanges that agree before a clock is believed: its stamps must advance as ours do
_SETTLED = 8  # exchanges before the quickest of them counts as one that met no queue


def smoothed(before: float | None, now: float) -> float:
    """As the round trip time of TCP is."""
    return now if before is None else before + _SMOOTHING * (now - before)


class ClockFilter:
    """A Kalman filter over [offset (us), drift (us/s = ppm)] of edge time minus agent time.

    Measurement: RFC 5905, section 8. An exchange that took longer than the quickest recent one
    waited in a queue, and how that wait was shared out between the ways is unknown: its variance
    grows with the square of the excess. A constant asymmetry of the path cannot be seen by any
    such filter and is not in `sigma_ns`; `asymmetry_ns` bounds it.
    """

    def __init__(self, config: ClockConfig) -> None:
        from filterpy.kalman import KalmanFilter  # takes a second to import: now, not at the first pong

        self._make_filter = KalmanFilter
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forgets everything: another clock."""
        self.accepted = 0
        self.rejected = 0
        self.steps = 0
        self.rtt_ms: float | None = None
        self._filter: Any = None
        self._base_ns = 0  # the state is relative to this offset, so that it stays small
        self._at_ns = 0
        self._recent_ns: deque[int] = deque(maxlen=self._config.least_of)
        self._unproven_ns: deque[int] = deque(maxlen=self._config.least_of)
        self._refused_in_a_row = 0
        self._agreeing = 0  # exchanges since the clock was last set

    @property
    def is_witnessed(self) -> bool:
        """Whether so many exchanges agree that it is a clock at all."""
        return self._agreeing >= _WITNESSES

    def update(self, sent_ns: int, received_ns: int, replied_ns: int, back_ns: int) -> bool:
        """One exchange: sent and back by the agent's clock, received and replied by the edge's.

        Returns whether it was believed.
        """
        exchange = Exchange(sent_ns, received_ns, replied_ns, back_ns)
        if not exchange.is_possible or abs(exchange.offset_ns) > MOST_APART_NS:
            self.rejected += 1
            return False
        rtt_ns, offset_ns = exchange.delay_ns, exchange.offset_ns
        middle_ns = (sent_ns + back_ns) // 2
        self._recent_ns.append(rtt_ns)
        self._unproven_ns.append(exchange.unproven_ns)
        self.rtt_ms = smoothed(self.rtt_ms, rtt_ns / 1e6)
        variance = self._variance(rtt_ns)
        if self._filter is None:
            self._start(offset_ns, middle_ns, variance)
            return True
        return self._correct(offset_ns, middle_ns, variance)

    def offset_ns(self, now_ns: int) -> int | None:
        """Edge time minus agent time at the agent's `now_ns`; None before the first exchange."""
        if self._filter is None:
            return None
        offset_us, drift_ppm = self._filter.x
        return self._base_ns + round(float(offset_us + drift_ppm * self._since_s(now_ns)) * 1e3)

    def sigma_ns(self, now_ns: int) -> float | None:
        """Standard deviation of `offset_ns`."""
        if self._filter is None:
            return None
        P = self._predicted(now_ns)[1]
        return float(np.sqrt(P[0, 0])) * 1e3

    @property
    def asymmetry_ns(self) -> int | None:
        """What `offset_ns` can be wrong by unseen, rounded up; None before the first exchange. It is half of
        the least sum, among recent exchanges, of the round trip by our own clock and the time that the edge
        says it held the question. Added, so that an edge that says it held it for long makes this more."""
        return -(-min(self._unproven_ns) // 2) if self._unproven_ns else None

    @property
    def drift_ppm(self) -> float | None:
        return None if self._filter is None else float(self._filter.x[1])

    def report(self) -> dict[str, Any]:
        """Plain data; the offset is that of the last exchange."""
        sigma_ns = self.sigma_ns(self._at_ns)
        return {
            "rtt_ms": self.rtt_ms,
            "clock_offset_ns": self.offset_ns(self._at_ns),
            "clock_sigma_ms": None if sigma_ns is None else sigma_ns / 1e6,
            "clock_drift_ppm": self.drift_ppm,
            "clock_steps": self.steps,
        }

    def _variance(self, rtt_ns: int) -> float:
        """us^2. Half the round trip is the most that an exchange can be wrong by (RFC 5905, section 8)."""
        settled = len(self._recent_ns) >= _SETTLED
        excess_us = (rtt_ns - (min(self._recent_ns) if settled else 0)) / 1e3
        return self._config.noise_us**2 + (self._config.asymmetry * excess_us) ** 2

    def _start(self, offset_ns: int, at_ns: int, variance: float) -> None:
        self._filter = self._make_filter(dim_x=2, dim_z=1)
        self._filter.x = np.zeros(2)
        self._filter.P = np.diag([variance, self._config.drift_ppm**2])
        self._filter.H = np.array([[1.0, 0.0]])
        self._base_ns, self._at_ns = offset_ns, at_ns
        self._refused_in_a_row = 0
        self._agreeing = 1
        self.accepted += 1

    def _correct(self, offset_ns: int, at_ns: int, variance: float) -> bool:
        kf = self._filter
        kf.x, kf.P = self._predicted(at_ns)
        self._at_ns = max(at_ns, self._at_ns)
        innovation = (offset_ns - self._base_ns) / 1e3 - kf.x[0]
        if innovation**2 > self._config.gate_sigma**2 * (kf.P[0, 0] + variance):
            return self._refuse(offset_ns, at_ns, variance)
        kf.update(np.array([(offset_ns - self._base_ns) / 1e3]), R=variance)
        self._refused_in_a_row = 0
        self._agreeing += 1
        self.accepted += 1
        return True

    def _refuse(self, offset_ns: int, at_ns: int, variance: float) -> bool:
        self._refused_in_a_row += 1
        self.rejected += 1
        if self._refused_in_a_row >= self._config.step_after:
            self.steps += 1
            self._start(offset_ns, at_ns, variance)
        return False

    def _predicted(self, now_ns: int) -> tuple[F64, F64]:
        """State and covariance at `now_ns`: random walks of the offset and of its drift."""
        dt = max(0.0, self._since_s(now_ns))
        F = np.array([[1.0, dt], [0.0, 1.0]])
        q, r = self._config.offset_walk_us**2, self._config.drift_walk_ppm**2
        Q = np.array([[q * dt + r * dt**3 / 3, r * dt**2 / 2], [r * dt**2 / 2, r * dt]])
        return F @ self._filter.x, F @ self._filter.P @ F.T + Q

    def _since_s(self, now_ns: int) -> float:
        return (now_ns - self._at_ns) / SECOND_NS
