"""The gauge: where a map as a whole lies in the frame that its agents are shown.

What is measured in a map is relative, so where it lies as a whole is a convention. Were it fixed by one
keyframe, the whole map would move whenever the way from there to where the agents are becomes better known:
all would see it move, though nothing changes between them. So the frame that is shown may lie off the one in
which the map is solved: a solution is put where it moves those in it least, the surest odometry least of all
(as the inner constraints of a free network do; Meissl, 1969). But no further off than the place of the surest
agent is uncertain: a drift that is known is corrected, for all alike.

So it is with each agent. Over seconds its odometry is surer than the map, so an agent stays where it was
shown while the solution is so near that it may as well be the solution that is wrong; else it is led there
only until it is so near.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.mapping.localisation_gate import AHEAD_M, body_motion, length_ahead
from share.types import F64

# How far from the solution an agent stays: its sigma, and at most so far, since two agents may be surer of
# each other than of where they are in the map.
_MAX_SLACK_M = 0.005


@dataclass(frozen=True, eq=False)
class SolvedPlace:
    """Where a solution puts an agent.

    T_map_odom, T_odom_body (4, 4): at its newest keyframe. sigma_m: of what is ahead of it
    (`share.mapping.localisation_gate.sigma_ahead`). step_variance: of the position after the newest step of
    its odometry, m^2.
    """

    T_map_odom: F64
    T_odom_body: F64
    sigma_m: float
    step_variance: float


class MapGauge:
    """Remembers where each segment was shown."""

    def __init__(self) -> None:
        self._published: dict[int, tuple[int, F64]] = {}  # by segment: reference segment, T_map_odom as shown

    def forget_all_but(self, segments: Collection[int]) -> None:
        """Forget all but these segments: the others have no keyframes."""
        self._published = {s: published for s, published in self._published.items() if s in segments}

    def show(self, reference_segment: int, places: Mapping[int, SolvedPlace]) -> dict[int, F64]:
        """Return T_map_odom (4, 4) to show to each segment of a map, for places as solved."""
        known = {s: self._published[s][1] for s in places if self._is_shown(s, reference_segment)}
        T_published_map = np.eye(4)
        if known:
            T_published_map = _gauge([places[s] for s in known], list(known.values()))
        T_map_odom = np.array([place.T_map_odom for place in places.values()]).reshape(-1, 4, 4)
        published = dict(zip(places, se3.orthonormal(T_published_map @ T_map_odom), strict=True))
        published |= {s: _led(places[s], before, published[s]) for s, before in known.items()}
        self._published |= {s: (reference_segment, T) for s, T in published.items()}
        return published

    def _is_shown(self, segment: int, reference_segment: int) -> bool:
        return self._published.get(segment, (None,))[0] == reference_segment


def _led(place: SolvedPlace, before: F64, solved: F64) -> F64:
    """Return T_map_odom (4, 4) between two of them: where an agent was shown before, and where it is."""
    way = body_motion(before, solved, place.T_odom_body)
    slack_m = min(place.sigma_m, _MAX_SLACK_M)
    share = max(0.0, 1 - slack_m / max(length_ahead(way), 1e-12))
    return se3.orthonormal(before @ place.T_odom_body @ se3.exp(share * way) @ se3.inverse(place.T_odom_body))


def _gauge(places: list[SolvedPlace], published: list[F64]) -> F64:
    """Return T_published_map (4, 4) that moves these agents least from T_map_odom as published before, as far
    as the place of the most certain one is uncertain."""
    solved_body = np.array([place.T_map_odom @ place.T_odom_body for place in places])
    published_body = np.array([T @ place.T_odom_body for T, place in zip(published, places, strict=True)])
    weights = 1 / np.array([place.step_variance for place in places])
    T = _least_motion(solved_body, published_body, weights / weights.sum())
    about = se3.from_rt(np.eye(3), solved_body[:, :3, 3].mean(axis=0))
    way = se3.log(se3.inverse(about) @ T @ about)
    most_m = min(place.sigma_m for place in places)
    return about @ se3.exp(way * min(1.0, most_m / max(length_ahead(way), 1e-12))) @ se3.inverse(about)


def _least_motion(poses: F64, goals: F64, weights: F64) -> F64:
    """Return the yaw rotation and translation (4, 4) that bring poses (N, 4, 4), and the points 3 m
    ahead of them, nearest to their goals, (N, 4, 4). weights (N,): their sum is 1."""
    centre, goal_centre = weights @ poses[:, :3, 3], weights @ goals[:, :3, 3]
    arms, goal_arms = poses[:, :3, 3] - centre, goals[:, :3, 3] - goal_centre
    turns = np.tensordot(weights, goals[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), 1)
    M = goal_arms.T @ (weights[:, None] * arms) + AHEAD_M**2 / 2 * turns
    angle = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    R = se3.so3_exp(np.array([0.0, 0.0, angle]))
    return se3.from_rt(R, goal_centre - R @ centre)
