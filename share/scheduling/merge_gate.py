"""Which verified loops are merged, judged from two poses: those that overlap as others did."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from share.config import ControlConfig
from share.geometry.camera import Camera, Rig
from share.scheduling.overlap import Frustum, SampledFrustum, overlap_volumes
from share.scheduling.policies import POLICIES
from share.types import F64

# ---- Which merges are skipped: those whose overlap is small against that of the merges before.
#
# P_skip = max(0, 1 - alpha_m V_new / V), V the mean overlap of the last N completed merges. Source: SHARE,
# IMWUT 10(3) 97, 2026.


@dataclass(frozen=True)
class MergeGateState:
    """eagerness: alpha_m; last: N. volumes: overlaps of merges that were completed, m^3, oldest first."""

    eagerness: float
    window: int
    overlap_volumes: tuple[float, ...] = ()

    @classmethod
    def from_config(cls, config: ControlConfig) -> MergeGateState:
        return cls(config.eagerness, config.merges)

    def after_merge(self, volume: float) -> MergeGateState:
        """After a merge with this overlap."""
        return MergeGateState(self.eagerness, self.window, (*self.overlap_volumes, volume)[-self.window :])

    def skip_probability(self, volume: float, same_map: bool) -> float:
        """Of a merge with this overlap, m^3. joined: the two sides are in one map already.

        0 for maps that are not joined yet, and where nothing was merged that it could be compared with.
        """
        total = sum(self.overlap_volumes)
        if not same_map or total <= 0:
            return 0.0
        return max(0.0, 1 - self.eagerness * volume * len(self.overlap_volumes) / total)

    def should_skip(self, volume: float, same_map: bool, draw: float) -> bool:
        """Whether it is left out. draw: uniform in [0, 1), the caller's."""
        return draw < self.skip_probability(volume, same_map)


_CACHED_CAMERAS = 64  # remembered: agents have few sorts of them


class MergeGate:
    """Of one edge, by its policy; one that gates nothing lets everything through."""

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._is_enabled = POLICIES[policy].has_merge_gate
        self._state = MergeGateState.from_config(config)
        self._rng = np.random.default_rng(config.gate_seed)

        @lru_cache(_CACHED_CAMERAS)
        def sampled_frustum(camera: Camera) -> SampledFrustum:
            return SampledFrustum(Frustum.from_camera(camera, config.near_m, config.far_m), config.interval_m)

        self._sampled_frustum = sampled_frustum

    def overlap_volume(self, a: Rig, b: Rig, T_a_b: F64) -> float:
        """m^3 that cam0 of both agents see; b's body stands at T_a_b (4, 4) as seen from a's."""
        if not self._is_enabled:
            return 0.0
        T_a_camb = T_a_b @ b.T_body_cam0
        return float(
            overlap_volumes(
                self._sampled_frustum(a.cam0), a.T_body_cam0, self._sampled_frustum(b.cam0), T_a_camb[None]
            )[0]
        )

    def skip_reason(self, volume: float, same_map: bool) -> str:
        """Why a merge with this overlap is skipped, for a person; empty if it is not. joined: the two are in
        one map already."""
        if not self._is_enabled or not self._state.should_skip(volume, same_map, float(self._rng.random())):
            return ""
        probability = self._state.skip_probability(volume, same_map)
        return (
            f"would add little: views overlap by {volume:.1f} m³, skipped with a chance of {probability:.0%}"
        )

    def record_merge(self, volume: float) -> None:
        """A merge with this overlap was done."""
        self._state = self._state.after_merge(volume)
