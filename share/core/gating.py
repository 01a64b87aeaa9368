"""Which verified loops are merged, judged from two poses: those that overlap as others did."""

from __future__ import annotations

import numpy as np

from share.config import ControlConfig
from share.control.gate import Gate
from share.control.overlap import Overlap
from share.control.policies import POLICIES
from share.types import F64


class Gating:
    """Of one edge, by its policy; one that gates nothing lets everything through."""

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._overlap = Overlap.of(config) if POLICIES[policy].gated else None
        self._gate = Gate.of(config)
        self._rng = np.random.default_rng(config.gate_seed)

    def volume(self, T_a_b: F64) -> float:
        """m^3 that cameras a and b both see; b stands at T_a_b (4, 4) as seen from a."""
        return 0.0 if self._overlap is None else float(self._overlap.volumes(np.eye(4), T_a_b[None])[0])

    def refuses(self, volume: float, joined: bool) -> str:
        """Why a merge with this overlap is skipped, for a person; empty if it is not. joined: the two are in
        one map already."""
        if self._overlap is None or not self._gate.skips(volume, joined, float(self._rng.random())):
            return ""
        chance = self._gate.skip_probability(volume, joined)
        return f"would add little: views overlap by {volume:.1f} m³, skipped with a chance of {chance:.0%}"

    def completed(self, volume: float) -> None:
        """A merge with this overlap was done."""
        self._gate = self._gate.completed(volume)
