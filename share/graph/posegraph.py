"""How one pose was seen from another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.types import F64, checked, checked_pose


@dataclass(frozen=True, eq=False)
class Edge:
    """Pose b as measured from pose a: T_a_b (4, 4) and its covariance (6, 6), perturbed on the right."""

    a: int
    b: int
    T_a_b: F64
    cov: F64

    def __post_init__(self) -> None:
        if self.a == self.b or min(self.a, self.b) < 0:
            raise ValueError(f"edge: {self.a} - {self.b} does not join two poses")
        object.__setattr__(self, "T_a_b", checked_pose("T_a_b", self.T_a_b))
        object.__setattr__(self, "cov", checked("cov", self.cov, (6, 6), np.float64))

    def reverse(self) -> Edge:
        """The same, from the other end."""
        return Edge(self.b, self.a, se3.inverse(self.T_a_b), se3.inverse_cov(self.T_a_b, self.cov))

    @property
    def spread(self) -> float:
        """Trace of the covariance: one number for how loose the edge is."""
        return float(self.cov.trace())
