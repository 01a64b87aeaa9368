"""Motion of the trunk in walking (bob, sway, heel strikes) and in standing.

* Step frequency: step length / step frequency is constant in free walking, the walk ratio of about
  0.0065 m per step/min = 0.39 m s (Sekiya & Nagasaki, Gait & Posture 7, 1998), so f = sqrt(v / 0.39).
* The centre of mass moves vertically by 2.7 cm at 0.7 m/s, 4.8 cm at 1.6 m/s, and to the sides by 7.0
  and 3.9 cm, peak to peak (Orendurff et al., J. Rehabil. Res. Dev. 41(6A), 2004).
* A heel strike reaches the head as a pulse of about 1.5 m/s^2 at 1.4 m/s, well below 20 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.lab.emulate.motion.track import KNOT_S, PlanarTrack, random_wander
from share.types import F64

WALK_RATIO = 0.39  # m s
_SPEEDS = (0.0, 0.7, 1.6, 2.2)  # m/s
_BOB_M = (0.012, 0.0274, 0.0483, 0.055)  # m, peak to peak
_SWAY_M = (0.05, 0.0699, 0.0385, 0.03)
_JOLT_M, _JOLT_S = 0.0006, 0.020  # at 1.4 m/s: 0.6 mm, sigma 20 ms: 1.5 m/s^2
_STANDING_M, _BREATH_M = 0.0025, 0.0012  # rms


@dataclass(frozen=True, eq=False)
class Gait:
    """phase (M,) rad, 2 pi a step, with a heel strike at each multiple; vigour (M,) 0 standing .. 1 walking;
    sideways, up (M,) m: of the trunk from its smooth track."""

    phase: F64
    vigour: F64
    sideways: F64
    up: F64


def make_gait(track: PlanarTrack, rng: np.random.Generator) -> Gait:
    """Return the gait of a body that moves along `track`."""
    v, t = track.speed, track.seconds
    phase, vigour = step_phase(v, rate=1 + 0.02 * random_wander(rng, t, (2.0, 6.0)))
    bob, sway = (np.interp(v, _SPEEDS, size) * vigour / 2 for size in (_BOB_M, _SWAY_M))
    quiet = _STANDING_M * random_wander(rng, t, (1.8, 9.0), 6)
    breath = _BREATH_M * random_wander(rng, t, (3.2, 4.4), 2)
    return Gait(
        phase=phase,
        vigour=vigour,
        sideways=sway * np.sin(phase / 2) + quiet,
        up=-bob * np.cos(phase) + breath - _heel_strikes(phase, v, t),
    )


def step_phase(speed: F64, rate: F64 | float = 1.0) -> tuple[F64, F64]:
    """Return phase (M,) rad and vigour (M,) of a body with `speed` (M,) m/s, every KNOT_S."""
    v = speed.clip(0)
    vigour = (v / 0.45).clip(0, 1)
    vigour = vigour**2 * (3 - 2 * vigour)
    turning = 2 * np.pi * np.sqrt(v / WALK_RATIO) * vigour * rate
    return np.concatenate([[0.0], np.cumsum((turning[1:] + turning[:-1]) / 2)]) * KNOT_S, vigour


def _heel_strikes(phase: F64, speed: F64, seconds: F64) -> F64:
    """Return displacement (M,) m by heel strikes: smooth pulses, slightly delayed."""
    out = np.zeros(len(seconds))
    reach = round(5 * _JOLT_S / KNOT_S)
    for i in np.flatnonzero(np.diff(np.floor(phase / (2 * np.pi))) > 0):
        middle = i + round(1.5 * _JOLT_S / KNOT_S)
        near = slice(max(0, middle - reach), middle + reach + 1)
        pulse = np.exp(-0.5 * ((seconds[near] - middle * KNOT_S) / _JOLT_S) ** 2)
        out[near] += _JOLT_M * min(speed[i] / 1.4, 1.3) * pulse
    return out
