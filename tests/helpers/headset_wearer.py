"""A wearer who walks and looks around, as a device on the head and the headset itself see it: pairs of poses
that both drift, as a headset's alignment takes them."""

from __future__ import annotations

import numpy as np
from helpers.headset_reference import PosePair

from share.geometry import se3
from share.types import F64

T_body_viewer = se3.exp(np.array([1.2, -0.3, 0.5, 0.02, -0.08, 0.05]))
MAP_SIGMA = np.repeat([np.radians(0.08), 0.005], 3)
HZ, SECONDS = 10, 60


def wearer(seed: int, mount_error: F64 | None = None, pair_hz: int = HZ) -> tuple[list[PosePair], F64]:
    """Return pairs of a wearer who walks and looks around, and the true T_map_viewer (N, 4, 4)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, SECONDS, 1 / pair_hz)
    hz, phase = rng.uniform(0.1, 0.5, 6), rng.uniform(0, 2 * np.pi, 6)
    waves = np.sin(2 * np.pi * hz * t[:, None] + phase)
    R = se3.so3_exp(waves[:, :1] * [0, 0, 1.2]) @ se3.so3_exp(waves[:, 1:2] * [0.4, 0, 0])
    T_map_viewer = se3.from_rt(R, waves[:, 3:] * [1.5, 1.5, 0.1] + [4, 3, 1.7])
    errors, lasting = np.zeros((len(t), 6)), np.exp(-1 / (pair_hz * 8))
    for k in range(1, len(t)):
        errors[k] = lasting * errors[k - 1] + np.sqrt(1 - lasting**2) * MAP_SIGMA * rng.normal(size=6)
    walk = np.cumsum(rng.normal(size=(len(t), 6)), 0) * np.repeat([0.0002, 0.001], 3) / np.sqrt(pair_hz)
    drift = np.eye(4) + np.zeros((len(t), 4, 4))
    drift[:, :3, :3], drift[:, :3, 3] = se3.so3_exp(walk[:, :3]), walk[:, 3:]
    local = (
        se3.exp(rng.normal(size=6)) @ drift @ T_map_viewer @ se3.exp(rng.normal(size=(len(t), 6)) * 0.0005)
    )
    mount = T_body_viewer if mount_error is None else T_body_viewer @ se3.exp(mount_error)
    body = T_map_viewer @ se3.inverse(mount) @ se3.exp(errors)
    cov = np.diag(MAP_SIGMA**2)
    pairs = [
        PosePair(*row, cov, viewer) for *row, viewer in zip(t, ["map"] * len(t), body, local, strict=True)
    ]
    return pairs, T_map_viewer
