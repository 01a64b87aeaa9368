"""How well a recording told where the motion capture's body sits."""

from __future__ import annotations

import numpy as np

from share.mocap.fit import Fit
from share.types import F64

MOST_TURN = np.radians(0.1)  # one sigma on the worst axis; more is said
MOST_SHIFT = 0.003  # m, likewise


def sigmas(fit: Fit) -> F64:
    """(10,) of `fit.cov_shared`: tilt (2) rad, body rotation (3) rad and position (3) m, offset s, drift."""
    return np.asarray(np.sqrt(np.diag(fit.cov_shared)), np.float64)


def unsure(fit: Fit) -> str | None:
    """What the motion did not tell, and what to do about it; None where it told all."""
    sigma = sigmas(fit)
    turn, shift = sigma[2:5].max(), sigma[5:8].max()
    if turn <= MOST_TURN and shift <= MOST_SHIFT:
        return None
    return (
        f"the motion tells the body to {np.degrees(turn):.2f} deg and {shift * 1e3:.1f} mm only (wanted: "
        f"{np.degrees(MOST_TURN):.1f} deg, {MOST_SHIFT * 1e3:.0f} mm); record a minute in which the device "
        "turns about all three axes, by a radian or more each"
    )
