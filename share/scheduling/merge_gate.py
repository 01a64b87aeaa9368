"""The merge gate: skips merges with little view overlap compared with previous merges.

P_skip = max(0, 1 - alpha_m V_new / V), V the mean overlap of the last N completed merges. Source: SHARE,
IMWUT 10(3) 97, 2026.
"""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import numpy as np

from share.config import NEAR_M, ControlConfig
from share.geometry.camera import Camera, Rig
from share.scheduling.overlap import Frustum, SampledFrustum, overlap_volumes
from share.scheduling.policies import POLICIES
from share.types import F64

INTERVAL_M = 0.5  # spacing of the points at which overlap is sampled
_CACHED_CAMERAS = 64  # sampled frusta kept; agents have few kinds of camera


class MergeGate:
    """The merge gate of one edge. It skips nothing if the policy has no gate."""

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._is_enabled = POLICIES[policy].has_merge_gate
        self._eagerness = config.eagerness  # alpha_m
        self._volumes: deque[float] = deque(maxlen=config.merges)  # of the last N completed merges, m^3
        self._rng = np.random.default_rng(config.random_seed)

        @lru_cache(_CACHED_CAMERAS)
        def sampled_frustum(camera: Camera) -> SampledFrustum:
            return SampledFrustum(Frustum.from_camera(camera, NEAR_M, config.far_m), INTERVAL_M)

        self._sampled_frustum = sampled_frustum

    def overlap_volume(self, a: Rig, b: Rig, T_a_b: F64) -> float:
        """Return the volume that cam0 of both agents see, m^3; 0 without a gate. T_a_b (4, 4): of their
        bodies."""
        if not self._is_enabled:
            return 0.0
        T_a_camb = T_a_b @ b.T_body_cam0
        return float(
            overlap_volumes(
                self._sampled_frustum(a.cam0), a.T_body_cam0, self._sampled_frustum(b.cam0), T_a_camb[None]
            )[0]
        )

    def skip_probability(self, volume: float, same_map: bool) -> float:
        """Return P_skip of a merge with this overlap, m^3. same_map: both sides are in one map already.

        0 between two maps, without completed merges, and without a gate.
        """
        total = sum(self._volumes)
        if not self._is_enabled or not same_map or total <= 0:
            return 0.0
        return max(0.0, 1 - self._eagerness * volume * len(self._volumes) / total)

    def skip_reason(self, volume: float, same_map: bool) -> str:
        """Return why a merge with this overlap is skipped, for a person; empty if it is not. Parameters as in
        `skip_probability`."""
        probability = self.skip_probability(volume, same_map)
        if self._is_enabled and self._rng.random() < probability:
            return f"small gain: views overlap by {volume:.1f} m³, skipped with probability {probability:.0%}"
        return ""

    def record_merge(self, volume: float) -> None:
        """Record a completed merge with this overlap, m^3."""
        self._volumes.append(volume)
