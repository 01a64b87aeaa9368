"""Which verified loops are merged, judged from two poses: those that overlap as others did."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from share.config import ControlConfig
from share.geometry.camera import Camera, Rig
from share.scheduling.overlap import Frustum, Seen, volumes
from share.scheduling.policies import POLICIES
from share.types import F64

# ---- Which merges are skipped: those whose overlap is small against that of the merges before.
#
# P_skip = max(0, 1 - alpha_m V_new / V), V the mean overlap of the last N completed merges. Source: SHARE,
# IMWUT 10(3) 97, 2026.


@dataclass(frozen=True)
class Gate:
    """eagerness: alpha_m; last: N. volumes: overlaps of merges that were completed, m^3, oldest first."""

    eagerness: float
    last: int
    volumes: tuple[float, ...] = ()

    @classmethod
    def of(cls, config: ControlConfig) -> Gate:
        return cls(config.eagerness, config.merges)

    def completed(self, volume: float) -> Gate:
        """After a merge with this overlap."""
        return Gate(self.eagerness, self.last, (*self.volumes, volume)[-self.last :])

    def skip_probability(self, volume: float, joined: bool) -> float:
        """Of a merge with this overlap, m^3. joined: the two sides are in one map already.

        0 for maps that are not joined yet, and where nothing was merged that it could be compared with.
        """
        total = sum(self.volumes)
        if not joined or total <= 0:
            return 0.0
        return max(0.0, 1 - self.eagerness * volume * len(self.volumes) / total)

    def skips(self, volume: float, joined: bool, draw: float) -> bool:
        """Whether it is left out. draw: uniform in [0, 1), the caller's."""
        return draw < self.skip_probability(volume, joined)


_CAMERAS = 64  # remembered: agents have few sorts of them


class Gating:
    """Of one edge, by its policy; one that gates nothing lets everything through."""

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._gated = POLICIES[policy].gated
        self._gate = Gate.of(config)
        self._rng = np.random.default_rng(config.gate_seed)

        @lru_cache(_CAMERAS)
        def seen(camera: Camera) -> Seen:
            return Seen(Frustum.of(camera, config.near_m, config.far_m), config.interval_m)

        self._seen = seen

    def volume(self, a: Rig, b: Rig, T_a_b: F64) -> float:
        """m^3 that cam0 of both agents see; b's body stands at T_a_b (4, 4) as seen from a's."""
        if not self._gated:
            return 0.0
        T_a_camb = T_a_b @ b.T_body_cam0
        return float(volumes(self._seen(a.cam0), a.T_body_cam0, self._seen(b.cam0), T_a_camb[None])[0])

    def refuses(self, volume: float, joined: bool) -> str:
        """Why a merge with this overlap is skipped, for a person; empty if it is not. joined: the two are in
        one map already."""
        if not self._gated or not self._gate.skips(volume, joined, float(self._rng.random())):
            return ""
        chance = self._gate.skip_probability(volume, joined)
        return f"would add little: views overlap by {volume:.1f} m³, skipped with a chance of {chance:.0%}"

    def completed(self, volume: float) -> None:
        """A merge with this overlap was done."""
        self._gate = self._gate.completed(volume)
