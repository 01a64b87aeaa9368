"""Initial values of a camera calibration: Zhang's closed form on homographies, without distortion.

Each view of a flat target gives a homography H = K [r1 r2 t]. That r1 and r2 are orthonormal gives two
equations linear in 1/fx^2 and 1/fy^2 with the principal point at the image's centre (Zhang, A flexible new
technique for camera calibration, PAMI 2000; the fixed centre as in Bouguet's toolbox). OpenCV fits the
homographies by normalised least squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera
from share.geometry.lens import EQUIDISTANT, lens_model
from share.geometry.se3 import hat
from share.types import F64

MIN_CORNERS = 6
_FISHEYE_FOCALS = (0.15, 1.5)  # range of trial focal lengths over the image's longer side
_FISHEYE_TRIALS = 48
_MIN_SINGULAR_RATIO = 1e-3  # of the smallest singular value to the largest


def initial_pinhole(boards: Sequence[F64], pixels: Sequence[F64], size: tuple[int, int]) -> Camera:
    """Return a camera without distortion from views of corners (N, 2) m and (N, 2) px.

    Raises ValueError where the views do not determine its focal lengths.
    """
    middle = (np.array(size) - 1) / 2
    rows = [_focal_equations(homography(xy, px - middle)) for xy, px in zip(boards, pixels, strict=True)]
    A, b = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    inverse_squares = np.linalg.lstsq(A, b, rcond=None)[0]
    if not (np.isfinite(inverse_squares).all() and (inverse_squares > 0).all()):
        raise ValueError(
            "the views do not determine the focal length: tilt the board against the camera; or is --target "
            "another board?"
        )
    fx, fy = inverse_squares**-0.5
    return Camera(*size, float(fx), float(fy), float(middle[0]), float(middle[1]), (0.0,) * 4)


def board_pose(camera: Camera, board: F64, px: F64) -> F64:
    """Return T_cam_target (4, 4) of one view in closed form: [r1 r2 t] of the homography of normalised
    corners."""
    if camera.is_fisheye:
        return _pose_from_rays(camera.directions(px), board)
    H = homography(board, camera.normalise(px))
    return _pose_from_homography(H * np.sign(H[2, 2]))


def initial_fisheye(boards: Sequence[F64], pixels: Sequence[F64], size: tuple[int, int]) -> Camera:
    """Return a fisheye camera without coefficients, its axis at the image's centre: the best of many trial
    focal lengths.

    Raises ValueError where none fits.
    """
    best, lowest_cost = None, np.inf
    cx, cy = ((side - 1) / 2 for side in size)
    for f in (np.geomspace(*_FISHEYE_FOCALS, _FISHEYE_TRIALS) * max(size)).tolist():
        camera = Camera(*size, f, f, cx, cy, (0.0,) * 4, EQUIDISTANT)
        errors_px = [_reprojection_errors(camera, xy, px) for xy, px in zip(boards, pixels, strict=True)]
        if (cost := float(np.median(np.concatenate(errors_px)))) < lowest_cost:
            best, lowest_cost = camera, cost
    if best is None:
        raise ValueError(
            "the views do not determine the focal length of a fisheye lens; is --target another board?"
        )
    return best


def _reprojection_errors(camera: Camera, board: F64, px: F64) -> F64:
    """Return the distances (N,) px of corners from their projections by a pose fitted to them; inf where
    there is none."""
    if np.isnan(camera.directions(px)).any():
        return np.full(len(px), np.inf)
    T = board_pose(camera, board, px)
    points = board @ T[:3, :2].T + T[:3, 3]
    distances: F64 = np.linalg.norm(camera.project_wide(points) - px, axis=1)
    return np.nan_to_num(distances, nan=np.inf)


def _pose_from_rays(ray: F64, board: F64) -> F64:
    """Return T_cam_target (4, 4) from unit vectors (N, 3), NaN where unknown, to corners (N, 2) m.

    Direct linear transform of ray x (H xy1) = 0, which holds behind the camera too.
    """
    known = np.isfinite(ray).all(axis=1)
    ray, xy = ray[known], board[known]
    middle, scale = xy.mean(axis=0), float(xy.std())
    normalised_board = np.column_stack([(xy - middle) / scale, np.ones(len(xy))])
    A = (hat(ray)[:, :, :, None] * normalised_board[:, None, None, :]).reshape(-1, 9)
    H = np.linalg.svd(A, full_matrices=False)[2][-1].reshape(3, 3)
    H = H @ np.array([[1 / scale, 0, -middle[0] / scale], [0, 1 / scale, -middle[1] / scale], [0, 0, 1.0]])
    depths = np.einsum("ni,ij,nj->n", ray, H, np.column_stack([xy, np.ones(len(xy))]))
    return _pose_from_homography(H * np.sign(np.median(depths)))


def _pose_from_homography(H: F64) -> F64:
    """Return T_cam_target (4, 4) from H = [r1 r2 t] up to a positive scale."""
    H = H / np.linalg.norm(H[:, :2], axis=0).mean()
    T = np.eye(4)
    T[:3, :3] = np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])])
    T[:3, 3] = H[:, 2]
    return se3.orthonormal(T)


def has_enough_corners(board: F64) -> bool:
    """Return whether corners (N, 2) m determine a homography: at least `MIN_CORNERS`, and neither all nor all
    but one on one line.

    By the rank of the direct linear transform from the board to itself.
    """
    if len(board) < MIN_CORNERS:
        return False
    points = np.column_stack([(board - board.mean(axis=0)) / board.std(), np.ones(len(board))])
    x, y, zeros = points[:, :1], points[:, 1:2], np.zeros_like(points)
    A = np.vstack([np.hstack([-points, zeros, x * points]), np.hstack([zeros, -points, y * points])])
    singular_values = np.linalg.svd(A, compute_uv=False)
    return bool(singular_values[7] > _MIN_SINGULAR_RATIO * singular_values[0])


def homography(board: F64, image: F64) -> F64:
    """Return H (3, 3) from (N, 2) on the board to (N, 2) in the image, up to scale, by least squares."""
    H, _ = cv2.findHomography(np.ascontiguousarray(board), np.ascontiguousarray(image))
    if H is None:
        raise ValueError("the corners of a view lie on one line")
    return np.asarray(H, float)


def _focal_equations(H: F64) -> tuple[F64, F64]:
    """Return A (2, 2), b (2,) of A (1/fx^2, 1/fy^2) = b: r1 . r2 = 0 and |r1| = |r2|."""
    H = H / np.linalg.norm(H[:, 0])
    (a, b), (c, d), (e, f) = H[:, :2]
    A = np.array([[a * b, c * d], [a * a - b * b, c * c - d * d]])
    return A, -np.array([e * f, e * e - f * f])


# Projection with derivatives. Parameters as in `share.geometry.lens`: fx fy cx cy, then k1 k2 p1 p2 [k3] of
# radtan, k1 k2 k3 k4 of equidistant.

_RADTAN_NAMES, _EQUIDISTANT_NAMES = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")


def parameter_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of a camera's estimated parameters, in order."""
    coefficients = _EQUIDISTANT_NAMES if camera.model == EQUIDISTANT else _RADTAN_NAMES
    return "fx", "fy", "cx", "cy", *coefficients[: max(len(camera.distortion), 4)]


def intrinsics(camera: Camera) -> F64:
    """Return the values (I,) of `parameter_names`."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *(camera.distortion or (0.0,) * 4)])


def camera_from_parameters(parameters: F64, template: Camera) -> Camera:
    """Return a camera with `parameters` (I,) and the template's image size and lens model. Raises
    ValueError."""
    fx, fy, cx, cy, *distortion = (float(value) for value in parameters)
    return Camera(template.width, template.height, fx, fy, cx, cy, tuple(distortion), template.model)


def project_with_jacobians(camera: Camera, points: F64) -> tuple[F64, F64, F64]:
    """Project points (N, 3) of the camera frame: px (N, 2), d px / d intrinsics (N, 2, I), d px / d points
    (N, 2, 3).

    NaN out of the lens's range: behind the camera, unless it is a fisheye.
    """
    lens = lens_model(camera.model, camera.distortion or (0.0,) * 4)
    if not camera.is_fisheye:
        points = np.where(points[:, 2:] > 1e-6, points, np.nan)
    distorted, scale = lens.distort_points(points), np.array([camera.fx, camera.fy])
    jacobian_intrinsics = np.zeros((len(points), 2, len(parameter_names(camera))))
    jacobian_intrinsics[:, 0, 0], jacobian_intrinsics[:, 1, 1] = distorted.T
    jacobian_intrinsics[:, 0, 2] = jacobian_intrinsics[:, 1, 3] = 1
    jacobian_intrinsics[:, :, 4:] = lens.coefficient_jacobian(points) * scale[:, None]
    return (
        distorted * scale + (camera.cx, camera.cy),
        jacobian_intrinsics,
        lens.point_jacobian(points) * scale[:, None],
    )


def transform_with_jacobian(T: F64, points: F64) -> tuple[F64, F64]:
    """Transform points (..., 3) of frame b by T_a_b (..., 4, 4); return also the derivatives (..., 3, 6)
    by xi of T_a_b Exp(xi)."""
    R = T[..., :3, :3]
    transformed = (R @ points[..., None])[..., 0] + T[..., :3, 3]
    return transformed, np.concatenate([-R @ hat(points), np.broadcast_to(R, (*points.shape, 3))], axis=-1)
