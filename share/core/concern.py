"""Which corrections an agent has to be told: those that move it, or that it waits for."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.types import Correction

_LEAST_M, _LEAST_RAD = 1e-3, float(np.radians(0.02))  # what moves an agent less, it does not notice


class Concern:
    """What every agent was told last. `agent` names one run of an agent."""

    def __init__(self) -> None:
        self._told: dict[str, Correction] = {}

    def forget(self, agent: str) -> None:
        self._told.pop(agent, None)

    def concerns(self, agent: str, correction: Correction) -> bool:
        """Whether it has to be sent; if so, it counts as told. It answers a keyframe, names another map, or
        moves odom by more than a millimetre or 0.02 degrees."""
        told = self._told.get(agent)
        if told is not None and not _is_news(told, correction):
            return False
        self._told[agent] = correction
        return True


def _is_news(told: Correction, new: Correction) -> bool:
    if new.answers >= 0 or new.map_id != told.map_id:
        return True
    moved = se3.inverse(told.T_map_odom) @ new.T_map_odom
    return bool(np.linalg.norm(moved[:3, 3]) > _LEAST_M or se3.angle(moved) > _LEAST_RAD)
