"""The gauge: where the map as a whole lies in the frame that is published to its agents.

Odometry and loops measure relative poses only, so the pose of a whole map is a convention. If one keyframe
fixed it, the map would move whenever the path from that keyframe to the agents becomes better known: all
would see it move, though nothing changes between them. So the published frame may differ from the one in
which the map is solved. A new solution is placed where it moves its agents least, weighted by the certainty
of their odometry (as the inner constraints of a free network do; Meissl, 1969). It is no further off than the
position of the most certain agent is uncertain: a drift that is known is corrected, for all alike.

The same holds for each agent. Over seconds its odometry is more certain than the map. So its published pose
stays while the solution differs by less than its own uncertainty; else it moves until that is so.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.mapping.localisation_gate import AHEAD_M, body_motion, length_ahead
from share.types import F64

# An agent's published pose differs from the solution by at most its sigma and at most this, since two agents
# may know their relative pose better than their poses in the map.
_MAX_SLACK_M = 0.005


@dataclass(frozen=True, eq=False)
class SolvedPose:
    """The pose that a solution gives an agent.

    T_map_odom, T_odom_body (4, 4): at its newest keyframe. sigma_m: of what is ahead of it
    (`share.mapping.localisation_gate.sigma_ahead`). step_variance: of the position after the newest step of
    its odometry, m^2.
    """

    T_map_odom: F64
    T_odom_body: F64
    sigma_m: float
    step_variance: float


class MapGauge:
    """Remembers the published T_map_odom of each segment."""

    def __init__(self) -> None:
        self._published: dict[int, tuple[int, F64]] = {}  # by segment: reference segment, T_map_odom

    def forget_all_but(self, segments: Collection[int]) -> None:
        """Forget all but these segments: the others have no keyframes."""
        self._published = {s: published for s, published in self._published.items() if s in segments}

    def publish(self, reference_segment: int, solved: Mapping[int, SolvedPose]) -> dict[int, F64]:
        """Return T_map_odom (4, 4) to publish to each segment of a map, for poses as solved."""
        before = {s: self._published[s][1] for s in solved if self._is_published(s, reference_segment)}
        T_published_map = np.eye(4)
        if before:
            T_published_map = _gauge([solved[s] for s in before], list(before.values()))
        T_map_odom = np.array([pose.T_map_odom for pose in solved.values()]).reshape(-1, 4, 4)
        published = dict(zip(solved, se3.orthonormal(T_published_map @ T_map_odom), strict=True))
        published |= {s: _moved_near(solved[s], T, published[s]) for s, T in before.items()}
        self._published |= {s: (reference_segment, T) for s, T in published.items()}
        return published

    def _is_published(self, segment: int, reference_segment: int) -> bool:
        return self._published.get(segment, (None,))[0] == reference_segment


def _moved_near(pose: SolvedPose, before: F64, solved: F64) -> F64:
    """Return T_map_odom (4, 4) on the way from the one published before to the solved one, as near to the
    latter as the agent's uncertainty asks."""
    motion = body_motion(before, solved, pose.T_odom_body)
    slack_m = min(pose.sigma_m, _MAX_SLACK_M)
    share = max(0.0, 1 - slack_m / max(length_ahead(motion), 1e-12))
    moved = before @ pose.T_odom_body @ se3.exp(share * motion)
    return se3.orthonormal(moved @ se3.inverse(pose.T_odom_body))


def _gauge(poses: list[SolvedPose], published: list[F64]) -> F64:
    """Return T_published_map (4, 4) that moves these agents least from their published T_map_odom, as far as
    the position of the most certain one is uncertain."""
    solved_body = np.array([pose.T_map_odom @ pose.T_odom_body for pose in poses])
    published_body = np.array([T @ pose.T_odom_body for T, pose in zip(published, poses, strict=True)])
    weights = 1 / np.array([pose.step_variance for pose in poses])
    T = _least_motion(solved_body, published_body, weights / weights.sum())
    T_map_centre = se3.from_rt(np.eye(3), solved_body[:, :3, 3].mean(axis=0))
    motion = se3.log(se3.inverse(T_map_centre) @ T @ T_map_centre)
    share = min(1.0, min(pose.sigma_m for pose in poses) / max(length_ahead(motion), 1e-12))
    return T_map_centre @ se3.exp(motion * share) @ se3.inverse(T_map_centre)


def _least_motion(poses: F64, goals: F64, weights: F64) -> F64:
    """Return the yaw rotation and translation (4, 4) that bring poses (N, 4, 4), and the points 3 m
    ahead of them, nearest to their goals (N, 4, 4). weights (N,): their sum is 1."""
    centre, goal_centre = weights @ poses[:, :3, 3], weights @ goals[:, :3, 3]
    arms, goal_arms = poses[:, :3, 3] - centre, goals[:, :3, 3] - goal_centre
    rotations = np.tensordot(weights, goals[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), 1)
    M = goal_arms.T @ (weights[:, None] * arms) + AHEAD_M**2 / 2 * rotations
    angle = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    R = se3.so3_exp(np.array([0.0, 0.0, angle]))
    return se3.from_rt(R, goal_centre - R @ centre)
