"""The edge's clock as seen from the agent: offset, drift and round trip, from ping and pong."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from share.timing import SECOND_NS, PeriodicTimer
from share.types import F64
from share.wire.messages import Ping, Pong


@dataclass(frozen=True)
class Exchange:
    """One request and reply between two clocks, ns (RFC 5905, section 8). sent_ns (T1), returned_ns (T4): by
    our clock. received_ns (T2), replied_ns (T3): by the other."""

    sent_ns: int
    received_ns: int
    replied_ns: int
    returned_ns: int

    @property
    def offset_ns(self) -> int:
        """Other clock minus ours, rounded down. Its error is half the difference of the two path delays, at
        most half of `delay_ns`."""
        return ((self.received_ns - self.sent_ns) + (self.replied_ns - self.returned_ns)) // 2

    @property
    def delay_ns(self) -> int:
        """Round trip delay on the network. Negative only if a clock was set in between."""
        return (self.returned_ns - self.sent_ns) - (self.replied_ns - self.received_ns)

    @property
    def middle_ns(self) -> int:
        """Time of `offset_ns`, by our clock."""
        return (self.sent_ns + self.returned_ns) // 2

    @property
    def unverified_ns(self) -> int:
        """Twice the error bound of `offset_ns` if one of the other side's two times is forged: the other
        time was read within the exchange, and our clock has measured its length."""
        return (self.returned_ns - self.sent_ns) + (self.replied_ns - self.received_ns)

    @property
    def is_valid(self) -> bool:
        """Whether the times are consistent with clocks that were not set in between."""
        return self.returned_ns >= self.sent_ns and self.replied_ns >= self.received_ns and self.delay_ns >= 0


PING_S = 0.5  # interval of pings
NOISE_US = 20.0  # standard deviation of an exchange that was not queued
ASYMMETRY = 0.5  # error of an offset as a share of the delay above the minimum; 0.5 is the bound
OFFSET_WALK_US = 4.0  # random walk of the offset, per sqrt(s)
DRIFT_WALK_PPM = 0.05  # random walk of the drift, per sqrt(s)
DRIFT_PPM = 100.0  # initial standard deviation of the drift; in the bounds of the offset, it may be so large
LEAST_OF = 64  # recent exchanges, among which the minimum delay is taken and which bound the offset
STEP_AFTER = 5  # contradictory exchanges in a row after which the filter restarts: the clock was set
_SMOOTHING = 1 / 8  # RFC 6298, section 2
MAX_OFFSET_NS = 10 * 365 * 86_400 * SECOND_NS  # clocks start at boot: no machine has run for longer
_MIN_AGREEING = 3  # agreeing exchanges before a clock is accepted: its stamps must advance as ours do
_EXACT = 1e-6  # share of the variance that stays where the offset is moved to a bound
_MIN_EXCHANGES = 8  # exchanges before the fastest counts as free of queueing


def exponential_average(average: float | None, sample: float) -> float:
    """Return the new average, smoothed as the round trip time of TCP."""
    return sample if average is None else average + _SMOOTHING * (sample - average)


class ClockFilter:
    """Kalman filter over [offset (us), drift (us/s = ppm)] of edge time minus agent time.

    Measurement: RFC 5905, section 8. An exchange slower than the fastest recent one was queued, on an unknown
    part of the path: its variance grows with the square of the excess. Each exchange bounds the offset too,
    and the estimate stays within the bounds of all recent ones. No filter observes a constant asymmetry of
    the path: it is not in `sigma_ns`, but bounded by `asymmetry_ns`.
    """

    def __init__(self) -> None:
        from filterpy import kalman  # takes a second to import: now, not at the first pong

        self._kalman = kalman
        self.reset()

    def reset(self) -> None:
        """Drop all state, for another clock."""
        self.rejected = 0
        self.steps = 0
        self.rtt_ms: float | None = None
        self._x: F64 | None = None  # offset and drift (2,); None before the first exchange
        self._P: F64 = np.zeros((2, 2))
        self._base_ns = 0  # the filtered offset is relative to this, so that it stays small
        self._updated_ns = 0
        self._recent: deque[Exchange] = deque(maxlen=LEAST_OF)
        self._bound_us = 0.0  # of the error, at `_updated_ns`
        self._consecutive_rejects = 0
        self._agreeing_exchanges = 0  # since the clock was last set

    @property
    def is_confirmed(self) -> bool:
        """Whether enough exchanges agree to accept the clock."""
        return self._agreeing_exchanges >= _MIN_AGREEING

    def update(self, sent_ns: int, received_ns: int, replied_ns: int, returned_ns: int) -> bool:
        """Add an exchange; times as in `Exchange`. Return whether it was accepted."""
        exchange = Exchange(sent_ns, received_ns, replied_ns, returned_ns)
        if not exchange.is_valid or abs(exchange.offset_ns) > MAX_OFFSET_NS:
            self.rejected += 1
            return False
        self.rtt_ms = exponential_average(self.rtt_ms, exchange.delay_ns / 1e6)
        if self._x is None:
            self._initialise(exchange)
            return True
        return self._add(self._x, exchange, self._variance(exchange.delay_ns))

    def offset_ns(self, now_ns: int) -> int | None:
        """Return edge time minus agent time at the agent's `now_ns`; None before the first exchange."""
        if self._x is None:
            return None
        offset_us, drift_ppm = self._x
        return self._base_ns + round(float(offset_us + drift_ppm * self._elapsed_s(now_ns)) * 1e3)

    def sigma_ns(self, now_ns: int) -> float | None:
        """Return the standard deviation of `offset_ns`; None before the first exchange."""
        if self._x is None:
            return None
        P = self._predict(self._x, now_ns)[1]
        return float(np.sqrt(P[0, 0])) * 1e3

    @property
    def asymmetry_ns(self) -> int | None:
        """Bound of the error of `offset_ns` at the last exchange that any asymmetry of the path can cause,
        rounded up; None before the first exchange.

        By the recent exchanges, each with its `Exchange.unverified_ns`: the edge's stated holding time is
        added, so that an edge that overstates it enlarges the bound."""
        return None if self._x is None else math.ceil(self._bound_us * 1e3)

    @property
    def drift_ppm(self) -> float | None:
        return None if self._x is None else float(self._x[1])

    def report(self) -> dict[str, Any]:
        """Return plain data, with the offset at the last exchange."""
        sigma_ns = self.sigma_ns(self._updated_ns)
        return {
            "rtt_ms": self.rtt_ms,
            "clock_offset_ns": self.offset_ns(self._updated_ns),
            "clock_sigma_ms": None if sigma_ns is None else sigma_ns / 1e6,
            "clock_drift_ppm": self.drift_ppm,
            "clock_steps": self.steps,
        }

    def _variance(self, rtt_ns: int) -> float:
        """Return the variance of an offset, us^2. Its error is at most half the round trip (RFC 5905,
        section 8)."""
        delays_ns = [one.delay_ns for one in self._recent]
        fastest_ns = min(rtt_ns, *delays_ns) if len(delays_ns) >= _MIN_EXCHANGES - 1 else 0
        excess_us = (rtt_ns - fastest_ns) / 1e3
        return NOISE_US**2 + (ASYMMETRY * excess_us) ** 2

    def _initialise(self, exchange: Exchange) -> None:
        self._recent = deque([exchange], LEAST_OF)
        self._x, self._P = np.zeros(2), np.diag([self._variance(exchange.delay_ns), DRIFT_PPM**2])
        self._base_ns, self._updated_ns = exchange.offset_ns, exchange.middle_ns
        self._bound_us = exchange.unverified_ns / 2e3
        self._consecutive_rejects = 0
        self._agreeing_exchanges = 1

    def _add(self, x: F64, exchange: Exchange, variance: float) -> bool:
        """Update with an exchange, unless its bounds contradict the last: the edge's clock was set."""
        self._x, self._P = x, P = self._predict(x, exchange.middle_ns)
        self._updated_ns = max(exchange.middle_ns, self._updated_ns)
        bounds = self._offset_bounds_us(exchange)
        if bounds is None:
            self._consecutive_rejects += 1
            self.rejected += 1
            if self._consecutive_rejects >= STEP_AFTER:
                self.steps += 1
                self._initialise(exchange)
            return False
        low, high = bounds
        self._recent.append(exchange)
        x, P = self._measure(x, P, (exchange.offset_ns - self._base_ns) / 1e3, variance)
        if not low <= x[0] <= high:
            nearest = min(max(float(x[0]), low), high)
            shift = nearest - float(x[0])
            x, P = self._measure(x, P, nearest, _EXACT * P[0, 0])
            P = P + np.diag([shift**2, 0.0])
        self._x, self._P = x, P
        self._bound_us = max(float(x[0]) - low, high - float(x[0]))
        self._consecutive_rejects = 0
        self._agreeing_exchanges += 1
        return True

    def _measure(self, x: F64, P: F64, z: float, variance: float) -> tuple[F64, F64]:
        x, P = self._kalman.update(x, P, z, np.array([[variance]]), np.array([[1.0, 0.0]]))
        return x, P

    def _offset_bounds_us(self, exchange: Exchange) -> tuple[float, float] | None:
        """Return the least and the largest offset at `_updated_ns` that this and the recent exchanges allow;
        None if this one contradicts the last. Older ones than one that contradicts are left out: the clock's
        rate has changed since.

        A filter alone would leave them where one side waits for a core again and again: exchanges then err in
        one direction."""
        assert self._x is not None
        exchanges = [exchange, *reversed(self._recent)]
        times, offsets, unverified = np.array(
            [(e.middle_ns, e.offset_ns, e.unverified_ns) for e in exchanges]
        ).T
        age_s = np.abs(times - self._updated_ns) / SECOND_NS
        drift_ppm = max(DRIFT_PPM, abs(float(self._x[1])) + min(3 * math.sqrt(self._P[1, 1]), DRIFT_PPM))
        error_us = unverified / 2e3 + drift_ppm * age_s
        offset_us = (offsets - self._base_ns) / 1e3
        low = np.maximum.accumulate(offset_us - error_us)
        high = np.minimum.accumulate(offset_us + error_us)
        last = int(np.flatnonzero(low <= high)[-1])
        return (float(low[last]), float(high[last])) if last > 0 else None

    def _predict(self, x: F64, now_ns: int) -> tuple[F64, F64]:
        """Return state (2,) and covariance (2, 2) at `now_ns`, with random walks of offset and drift."""
        dt = max(0.0, self._elapsed_s(now_ns))
        F = np.array([[1.0, dt], [0.0, 1.0]])
        q, r = OFFSET_WALK_US**2, DRIFT_WALK_PPM**2
        Q = np.array([[q * dt + r * dt**3 / 3, r * dt**2 / 2], [r * dt**2 / 2, r * dt]])
        return F @ x, F @ self._P @ F.T + Q

    def _elapsed_s(self, now_ns: int) -> float:
        return (now_ns - self._updated_ns) / SECOND_NS


@dataclass(frozen=True)
class ClockEstimate:
    """The edge's monotonic clock minus the agent's, ms, if known well enough to compare stamps of two
    machines.

    sigma_ms: standard deviation by the filter. asymmetry_ms: bound of the error that no filter observes, by
    the agent's clock alone. Both None until the clock is confirmed; offset_ms also if it is not reliable.

    No latency or delay needs it: `track_ms`, `corrected_ms` and the delay of an evaluation are differences of
    the agent's clock, and a round trip is one less the edge's holding time. Only one-way delays depend on it.
    """

    offset_ms: float | None
    sigma_ms: float | None
    asymmetry_ms: float | None
    claim_ms: float  # config `clock.claim_ms`

    @classmethod
    def from_filter(cls, clock: ClockFilter, now_ns: int, claim_ms: float) -> ClockEstimate:
        """Return the estimate at `now_ns`; its sigma grows with the time since the last exchange."""
        offset_ns, sigma_ns = clock.offset_ns(now_ns), clock.sigma_ns(now_ns)
        asymmetry_ns = clock.asymmetry_ns
        if not clock.is_confirmed or offset_ns is None or sigma_ns is None or asymmetry_ns is None:
            return cls(None, None, None, claim_ms)
        estimate = cls(offset_ns / 1e6, sigma_ns / 1e6, asymmetry_ns / 1e6, claim_ms)
        return estimate if estimate.is_reliable else replace(estimate, offset_ms=None)

    @property
    def uncertainty_ms(self) -> float | None:
        if self.sigma_ms is None or self.asymmetry_ms is None:
            return None
        return self.sigma_ms + self.asymmetry_ms

    @property
    def is_reliable(self) -> bool:
        return self.uncertainty_ms is not None and self.uncertainty_ms <= self.claim_ms

    def report(self) -> dict[str, Any]:
        """Return plain data."""
        return {**asdict(self), "uncertainty_ms": self.uncertainty_ms, "is_reliable": self.is_reliable}


_MAX_IN_FLIGHT = 16


class PingTracker:
    """Sends pings and feeds the pongs to `clock`, the filter of the present edge session."""

    def __init__(self) -> None:
        self.clock = ClockFilter()
        self._timer = PeriodicTimer(PING_S)
        self._sequence = 0
        self._in_flight: deque[Ping] = deque(maxlen=_MAX_IN_FLIGHT)

    def due_ping(self, now_ns: int) -> Ping | None:
        """Return the ping to send now; None if none is due."""
        if not self._timer.fire_if_due(now_ns):
            return None
        self._sequence += 1
        self._in_flight.append(Ping(self._sequence, now_ns))
        return self._in_flight[-1]

    def take_answer(self, pong: Pong) -> bool:
        """Remove the ping that this pong answers from those in flight. Return whether there was one."""
        ping = Ping(pong.sequence, pong.sent_ns)
        is_pending = ping in self._in_flight
        if is_pending:
            self._in_flight.remove(ping)
        return is_pending

    def measure(self, pong: Pong, now_ns: int) -> None:
        """Add a pong of the present session, received at `now_ns`, to the clock filter."""
        self.clock.update(pong.sent_ns, pong.received_ns, pong.replied_ns, now_ns)

    def begin_session(self) -> None:
        """Start over for a new edge session, which has another clock."""
        self.clock.reset()
        self._in_flight.clear()
