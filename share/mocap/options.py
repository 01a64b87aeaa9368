"""What a user of the fit may choose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.types import F64


@dataclass(frozen=True, eq=False)
class FitOptions:
    """How to fit.

    sigma_position m, sigma_rotation rad: noise of the mocap, for samples that err independently
    independent_hz times a second; denser ones count for less each, and more than most_hz are not taken.
    cauchy: in sigmas, where a sample
    begins to be doubted. imu_inflation: times the data sheet's noise.
    within_s: how far apart the clocks may be, None for any distance, 0 for one clock; offset_sigma s:
    how far the offset may still be from there; drift_sigma: how much one clock may run faster than
    the other (1e-4: 100 ppm).
    T_body_mocap (4, 4): a guess, needed only for a body that turns about one axis; then with
    guess_sigma (rad, m). gravity m/s^2. node_s: time between nodes. bridge_s: longest hole in the mocap
    where the IMU's word is taken; break_s: longest that it is integrated across at all.
    """

    sigma_position: float = 0.002
    sigma_rotation: float = np.radians(0.3)
    independent_hz: float = 20.0
    most_hz: float = 250.0
    cauchy: float = 2.5
    imu_inflation: float = 2.0
    within_s: float | None = 0.5
    offset_sigma: float = 0.02
    drift_sigma: float = 1e-4
    T_body_mocap: F64 | None = None
    guess_sigma: tuple[float, float] = (np.radians(10.0), 0.3)
    gravity: float = 9.81
    node_s: float = 0.05
    bridge_s: float = 0.5
    break_s: float = 10.0
    max_iterations: int = 50
