"""IMU readings by machines and knocks: motion too small for a picture, with large accelerations.

A vibration is four rotors, each with a frequency of its own that drifts, and its double. A knock, as of a
wheel on the edge of a tile or of a heel, is a damped oscillation. Neither changes position or velocity in the
end: their accelerations are second derivatives of a displacement.
"""

from __future__ import annotations

import numpy as np

from share.lab.emulate.sensor.indexed_random import Seed
from share.types import F64

_ROTORS, _ROTOR_HZ, _WANDER_HZ, _WANDER_S = 4, (70.0, 110.0), 4.0, 2.0
_HARMONIC_AMPLITUDE = 0.5  # amplitude of the double frequency
_ROTATION_RATIO = 0.03  # rad/s of rotation for each m/s^2
_KNOCK_HZ, _KNOCK_S = (18.0, 40.0), 0.012  # frequency of the oscillation; time constant of its rise and decay
_GRID_HZ = 4000.0  # on which a knock is differentiated


def vibration_acceleration(seconds: F64, rms: float, seed: Seed) -> F64:
    """Return the acceleration (N, 3) m/s^2 at times (N,) s from the start, with `rms` on each axis. It does
    not depend on which other times are asked for."""
    grid = np.arange(0.0, max(float(seconds.max(initial=0.0)), 0.0) + _WANDER_S, _WANDER_S / 20)
    out = np.zeros((len(seconds), 3))
    decay = np.exp(-(grid[1] - grid[0]) / _WANDER_S) if len(grid) > 1 else 0.0
    for rotor in range(_ROTORS):
        rng = np.random.default_rng((*seed, 0, rotor))
        base, phase = rng.uniform(*_ROTOR_HZ), rng.uniform(0, 2 * np.pi, (2, 3))
        direction = rng.standard_normal((2, 3))
        wander = _gauss_markov(rng.standard_normal(len(grid)), decay) * _WANDER_HZ
        turns = np.concatenate([[0.0], np.cumsum((base + wander)[:-1] * np.diff(grid))])
        angle = 2 * np.pi * np.interp(seconds, grid, turns)[:, None]
        out += direction[0] * np.sin(angle + phase[0]) + _HARMONIC_AMPLITUDE * direction[1] * np.sin(
            2 * angle + phase[1]
        )
    rms_unscaled = np.sqrt(_ROTORS * (1 + _HARMONIC_AMPLITUDE**2) / 2)
    acceleration: F64 = rms / rms_unscaled * out
    return acceleration


def knock_acceleration(seconds: F64, peak: float, every_s: float, seed: Seed) -> F64:
    """Return the acceleration (N, 3) m/s^2 at times (N,) s: about `peak` each, at random times `every_s`
    apart."""
    rng = np.random.default_rng((*seed, 1))
    out, at, end = np.zeros((len(seconds), 3)), 0.0, float(seconds.max(initial=0.0))
    while (at := at + float(rng.exponential(every_s))) < end:
        hz, direction = rng.uniform(*_KNOCK_HZ), rng.standard_normal(3)
        t = np.arange(0.0, 20 * _KNOCK_S, 1 / _GRID_HZ)
        place = (t / _KNOCK_S) ** 3 * np.exp(-t / _KNOCK_S) * np.sin(2 * np.pi * hz * t)
        pulse = np.gradient(np.gradient(place, t), t)
        wave = np.interp(seconds - at, t, pulse / np.abs(pulse).max(), left=0.0, right=0.0)
        out += peak * wave[:, None] * direction / np.linalg.norm(direction)
    return out


def rotation_rates(acceleration: F64) -> F64:
    """Return angular rates (N, 3) rad/s of such a vibration: a force off the centre of mass also turns the
    body."""
    return _ROTATION_RATIO * np.roll(acceleration, 1, axis=1)


def _gauss_markov(white: F64, decay: float) -> F64:
    from scipy.signal import lfilter

    white = white.copy()
    white[1:] *= np.sqrt(1 - decay**2)
    out: F64 = lfilter([1.0], [1.0, -decay], white)
    return out
