"""Two cameras in a simulated room: views whose truth is known."""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.mapping.recognition.verification import CameraView
from share.types import F64, U8, View

FOCAL = 458.0
SIGMA_PX, SIGMA_RHO = 1.0, 0.01
X_CAM = se3.exp(np.array([0.1, -1.4, 0.2, 0.03, -0.05, 0.01]))  # T_body_cam0


def scene(seed: int, n: int = 400) -> tuple[F64, U8]:
    """Points (n, 3) m before a camera at the origin, and their descriptors (n, 32)."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([-0.8, -0.5], [0.8, 0.5], (n, 2))
    depth = rng.uniform(1.5, 5.0, (n, 1))
    return np.hstack([uv, np.ones((n, 1))]) * depth, rng.integers(0, 256, (n, 32), np.uint8)


def view(
    points: F64, descriptors: U8, T_cam_world: F64, rng: np.random.Generator, depth_share: float = 0.8
) -> View:
    """What the camera sees of the points, with noise in pixels, inverse depth and descriptor bits."""
    seen = se3.transform(T_cam_world, points)
    front = seen[:, 2] > 0.3
    seen, bits = seen[front], descriptors[front]
    uv = seen[:, :2] / seen[:, 2:] + rng.normal(0, SIGMA_PX / FOCAL, (len(seen), 2))
    rho = 1 / seen[:, 2] + rng.normal(0, SIGMA_RHO, len(seen))
    rho[rng.random(len(seen)) > depth_share] = np.nan
    flips = np.packbits(rng.random((len(seen), 256)) < 0.06, axis=1)
    return View(uv, np.column_stack([uv, np.ones(len(uv))]) / rho[:, None], bits ^ flips)


def sights(
    seed: int, T_c_q: F64, depth_share: float = 0.8, up: bool = True, n: int = 400
) -> tuple[CameraView, CameraView]:
    """Query and candidate; T_c_q (4, 4) between the cameras; the candidate's body stands upright."""
    rng = np.random.default_rng(seed + 1000)
    points, descriptors = scene(seed, n)
    query = view(points, descriptors, se3.inverse(T_c_q), rng, depth_share)
    candidate = view(points, descriptors, np.eye(4), rng, depth_share)
    order = rng.permutation(len(query))
    query = View(query.uv[order], query.points[order], query.descriptors[order])
    up_c = np.array([0.0, 0.0, 1.0])
    up_q = bodies(T_c_q)[:3, :3].T @ up_c
    none = np.zeros(3)
    return CameraView(query, FOCAL, X_CAM, up_q if up else none), CameraView(
        candidate, FOCAL, X_CAM, up_c if up else none
    )


def bodies(T_c_q: F64) -> F64:
    """The same relative pose between the bodies."""
    return X_CAM @ T_c_q @ se3.inverse(X_CAM)
