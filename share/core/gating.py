"""Which verified loops are merged, judged from two poses: those that overlap as others did."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from share.config import ControlConfig
from share.control.gate import Gate
from share.control.overlap import Frustum, Seen, volumes
from share.control.policies import POLICIES
from share.geometry.camera import Camera, Rig
from share.types import F64

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
