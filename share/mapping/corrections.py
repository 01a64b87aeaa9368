"""Events of the mapper about its agents, with the corrections that follow.

An agent is sent the corrections that it can notice. A correction that is held back is reported once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.event_kinds import EventKind
from share.geometry import se3
from share.mapping.map_solving import AppliedSolution
from share.types import F64, Correction

# Changes below both are not noticeable.
_MIN_SHIFT_M = 1e-3
_MIN_ROTATION_RAD = float(np.radians(0.02))


@dataclass(frozen=True, eq=False)
class MapsJoined:
    """The map `absorbed` is part of `survivor` from now on. T_survivor_absorbed (4, 4): as the mapper moved
    it; agents are shown it with their next correction."""

    survivor: str
    absorbed: str
    T_survivor_absorbed: F64


@dataclass(frozen=True, eq=False)
class MapEvent:
    """A decision with its reason, and the correction that follows, if any.

    agent: the run concerned; None where the event concerns the map `map_id`, or the whole mapper.
    """

    agent: str | None
    event: EventKind
    reason: str
    correction: Correction | None = None
    map_id: str | None = None
    joined: MapsJoined | None = None


def map_assignment(
    agent: str, map_id: str, T_map_odom: F64, about_id: int, cov: F64 | None = None
) -> MapEvent:
    """Event that assigns a run to a map. A map is named after its reference segment.

    about_id: a keyframe of the run's segment. cov (6, 6): of T_map_odom; None where it is exact, since the
    segment defines the map's frame.
    """
    verb = "starts" if map_id.startswith(f"{agent}/") else "is in"
    return MapEvent(
        agent,
        "correction",
        f"{verb} map {map_id}",
        Correction(T_map_odom, np.zeros((6, 6)) if cov is None else cov, map_id, 0, about_id),
    )


class CorrectionPublisher:
    """Remembers the last correction sent to each run, and which ones were reported as held back."""

    def __init__(self) -> None:
        self._last_sent: dict[str, Correction] = {}
        self._reported_waits: set[tuple[str, str]] = set()  # (run, map)

    def remove_agent(self, agent: str) -> None:
        self._last_sent.pop(agent, None)
        self._reported_waits = {(run, map_id) for run, map_id in self._reported_waits if run != agent}

    def publish(self, map_id: str, applied: AppliedSolution) -> list[MapEvent]:
        """Events for the corrections of a solved map, which count as sent."""
        sent = [
            MapEvent(agent, "correction", applied.reason, correction)
            for agent, correction in applied.corrections.items()
            if self._should_send(agent, correction)
        ]
        known = f"its position in map {map_id} is known to"
        waiting = [
            MapEvent(agent, "correction held back", f"{known} {100 * sigma_m:.0f} cm")
            for agent, sigma_m in applied.waiting_sigma_m.items()
            if (agent, map_id) not in self._reported_waits
        ]
        self._reported_waits |= {(agent, map_id) for agent in applied.waiting_sigma_m}
        return sent + waiting

    def _should_send(self, agent: str, correction: Correction) -> bool:
        """Return whether it answers a keyframe, names another map, or moves odom noticeably; if so, it counts
        as sent."""
        last_sent = self._last_sent.get(agent)
        if last_sent is not None and not _has_changed(last_sent, correction):
            return False
        self._last_sent[agent] = correction
        return True


def _has_changed(last_sent: Correction, new: Correction) -> bool:
    if new.answered_keyframe >= 0 or new.map_id != last_sent.map_id:
        return True
    moved = se3.inverse(last_sent.T_map_odom) @ new.T_map_odom
    return bool(np.linalg.norm(moved[:3, 3]) > _MIN_SHIFT_M or se3.rotation_angle(moved) > _MIN_ROTATION_RAD)
