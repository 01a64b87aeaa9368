"""How sure agents are of their odometry, beside each other, by what they say and as far as it is believed.

Nothing shows in loops yet when two maps are joined, and who is surest bends the others. So until loops
tell, nobody is believed to be much surer than the surest of the others: by variances of its steps over their
size, in the median, for position and for turn. The covariances come here as they are believed, with their
floors (`share.merge.floors`): a claim far below a floor counts as the floor, and is widened from there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

import numpy as np

from share.geometry import se3
from share.types import F64

_STEPS = 64  # of each agent: the newest
_ENOUGH = 8
_LEEWAY = 2.25  # variance: 1.5 sigma, as honest agents differ by how they move
_MOST = 100.0  # variance: words alone say no more
_LEVER = 1.0  # m: a turn of 1 rad is a step of this


class Claims:
    """Of agents, by what they say of their steps."""

    def __init__(self) -> None:
        self._of: dict[str, deque[tuple[float, float]]] = {}
        self._middle: dict[str, F64] = {}
        self._out: set[str] = set()
        self._met: dict[str, set[str]] = {}

    @property
    def agents(self) -> set[str]:
        """Of whom enough is known."""
        return set(self._middle)

    def add(self, agent: str, T_ref_body: F64, cov: F64) -> bool:
        """A step (4, 4) and its covariance (6, 6). Whether what it claims is known anew."""
        size = float(np.linalg.norm(T_ref_body[:3, 3]) + _LEVER * se3.angle(T_ref_body))
        turn, way = float(np.trace(cov[:3, :3])), float(np.trace(cov[3:, 3:]))
        if not min(size, turn, way) > 0:
            return False
        steps = self._of.setdefault(agent, deque(maxlen=_STEPS))
        steps.append((np.log(turn / size), np.log(way / size)))
        if len(steps) < _ENOUGH:
            return False
        self._middle[agent] = np.median(np.array(steps), axis=0)
        return True

    def met(self, one: str, other: str) -> None:
        """There is a loop between them: from now on they are measured by each other."""
        self._met.setdefault(one, set()).add(other)
        self._met.setdefault(other, set()).add(one)

    def remove(self, agent: str) -> None:
        """Nothing is left of it."""
        self._of.pop(agent, None)
        self._middle.pop(agent, None)
        self._out.discard(agent)
        for other in self._met.pop(agent, set()):
            self._met[other].discard(agent)

    def leave_out(self, agents: Collection[str]) -> bool:
        """Nobody is measured by these, from now on. Whether that is news."""
        was, self._out = self._out, set(agents)
        return was != self._out

    def least(self, agent: str) -> float:
        """By what its variances have to be multiplied at least; 1 where it says nothing unusual."""
        whom = self._met.get(agent, set()) - self._out
        others = [self._middle[name] for name in whom if name in self._middle]
        if agent not in self._middle or not others:
            return 1.0
        surest = np.min(others, axis=0)
        surer = float(np.exp((surest - self._middle[agent]).max()))
        return min(max(1.0, surer / _LEEWAY), _MOST)
