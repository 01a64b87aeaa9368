"""Patches of features from the image that saw them first, and their alignment to a tenth of a pixel.

Every later image is aligned with that first patch, so that tracks do not drift. Inverse-compositional
alignment (Baker & Matthews 2004): the derivatives are those of the patch, computed once; the patch is warped
as predicted, so that only a shift is estimated. It is invariant to gain and bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from share.array_table import ArrayTable
from share.types import F32, F64, U8

HALF_SIZE = 5  # px; patches are 11 x 11
_SIDE = 2 * HALF_SIZE + 1
_AXIS = np.arange(-HALF_SIZE, HALF_SIZE + 1, dtype=np.float32)
OFFSETS: F32 = np.stack(np.meshgrid(_AXIS, _AXIS), axis=-1).reshape(-1, 2)  # (S, 2) px, x and y
_MEAN: F32 = np.full(_SIDE**2, 1 / _SIDE**2, np.float32)
_MIN_CONTRAST = 1e-3  # norm of gray levels, below which a patch has no texture
_CONVERGED_PX = 0.02  # a step below this ends an alignment
_MAX_REMAP_ROWS = 30_000  # of the output of cv2.remap (SHRT_MAX)


@dataclass(frozen=True, eq=False)
class Patches(ArrayTable):
    """N patches of S samples, and what their alignment needs.

    contrast (N,): norm of the gray levels. inverse_hessian (N, 2, 2): of the shift. kernels (N, 3, S):
    `gray`, and the inverse-compositional steps; times samples of zero mean and unit norm they give the
    correlation and the shift, px.

    bend (N, 4, S): derivatives of the samples by the linear part of the warp, without what a shift explains:
    along x by the px to the right and down, then along y. rigid (N, 4, 4): bend times bend; at_rest (N, 4):
    bend times `gray`.
    """

    contrast: F32
    inverse_hessian: F32
    kernels: F32
    bend: F32
    rigid: F32
    at_rest: F32

    def __len__(self) -> int:
        return len(self.kernels)

    @property
    def gray(self) -> F32:
        """The samples (N, S), zero mean, unit norm."""
        return self.kernels[:, 0]

    @property
    def sigma_px(self) -> F32:
        """The shift error (N,) px by one gray level of noise, in the worst direction."""
        out: F32 = np.sqrt(np.linalg.eigvalsh(self.inverse_hessian)[:, 1])
        return out


def empty_patches() -> Patches:
    s = len(OFFSETS)
    shapes = ((0,), (0, 2, 2), (0, 3, s), (0, 4, s), (0, 4, 4), (0, 4))
    return Patches(*(np.zeros(shape, np.float32) for shape in shapes))


def extract(image: U8, px: F32) -> Patches:
    """Return the patches round px (N, 2)."""
    if len(px) == 0:
        return empty_patches()
    shift = _shift_equations(image, px)
    kernels, gradient, inverse_hessian = shift.kernels, shift.gradient, shift.inverse_hessian
    bend = (gradient[:, :, None] * OFFSETS.T).reshape(len(px), 4, -1)
    bend -= bend.mean(axis=2, keepdims=True)
    bend -= bend @ gradient.transpose(0, 2, 1) @ inverse_hessian @ gradient
    at_rest = (bend @ kernels[:, 0, :, None])[:, :, 0].astype(np.float32, copy=False)
    return Patches(shift.contrast, inverse_hessian, kernels, bend, bend @ bend.transpose(0, 2, 1), at_rest)


def extract_kernels(image: U8, px: F32) -> F32:
    """Return the kernels (N, 3, S) of the patches round px (N, 2): all that `align` needs, in half the
    time."""
    return empty_patches().kernels if len(px) == 0 else _shift_equations(image, px).kernels


class _ShiftEquations(NamedTuple):
    """Of N patches: contrast, inverse_hessian and kernels as in `Patches`; gradient (N, 2, S), without what
    gain and bias explain."""

    contrast: F32
    inverse_hessian: F32
    kernels: F32
    gradient: F32


def _shift_equations(image: U8, px: F32) -> _ShiftEquations:
    padded = sample_square(image, px, HALF_SIZE + 1).reshape(-1, _SIDE + 2, _SIDE + 2)
    dx = (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]) / 2
    dy = (padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]) / 2
    gradient = np.stack([dx, dy], axis=1).reshape(len(px), 2, -1)
    gray, contrast = _normalised(padded[:, 1:-1, 1:-1].reshape(len(px), -1))
    gradient = gradient - gradient.mean(axis=2, keepdims=True)
    gradient = gradient - (gradient @ gray[:, :, None]) * gray[:, None, :]
    normal = gradient @ gradient.transpose(0, 2, 1) + np.float32(1e-3) * np.eye(2, dtype=np.float32)
    inverse_hessian = np.linalg.inv(normal)
    kernels = np.concatenate([gray[:, None], contrast[:, None, None] * (inverse_hessian @ gradient)], axis=1)
    return _ShiftEquations(contrast, inverse_hessian, kernels, gradient)


@dataclass(frozen=True, eq=False)
class AlignedPatches:
    """px (N, 2): aligned positions. correlation (N,): 1 at best. last_step (N,): px of the last
    correction, small if converged. samples (N, S): the last samples, zero mean, unit norm."""

    px: F32
    correlation: F32
    last_step: F32
    samples: F32


def align(
    images: tuple[U8, ...],
    cam0_count: int,
    kernels: F32,
    px: F64,
    warp: F64,
    max_steps: int = 4,
) -> AlignedPatches:
    """Align patches with kernels (N, 3, S) from px (N, 2), warped by (N, 2, 2): d px here / d px in the
    patch.

    The first `cam0_count` are aligned in the first of one or two images, the others in the second.
    """
    n, all_kernels = len(kernels), kernels
    at, W = px.astype(np.float32), warp.astype(np.float32)
    correlation, last_step = np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
    samples = np.zeros((n, len(OFFSETS)), np.float32)
    x, y = W[:, 0] @ OFFSETS.T, W[:, 1] @ OFFSETS.T
    active = np.arange(n)
    for _ in range(max_steps):
        if len(active) == 0:
            break
        if len(active) < n:
            kernels, X, Y = all_kernels[active], x[active], y[active]
        else:
            X, Y = x, y
        centre = at[active]
        gray = _sampled(
            images, int(np.searchsorted(active, cam0_count)), X + centre[:, :1], Y + centre[:, 1:]
        )
        gray, _ = _normalised(gray)
        response = np.einsum("nks,ns->nk", kernels, gray)
        correlation[active], samples[active] = response[:, 0], gray
        move = np.einsum("nij,nj->ni", W[active], response[:, 1:])
        at[active] -= move
        step_px = np.hypot(move[:, 0], move[:, 1])
        last_step[active] = step_px
        active = active[(step_px > _CONVERGED_PX) & np.isfinite(step_px)]
    return AlignedPatches(at, correlation, last_step, samples)


def _sampled(images: tuple[U8, ...], cam0_count: int, x: F32, y: F32) -> F32:
    """Return gray levels (N, S), the first `cam0_count` from the first image."""
    if cam0_count >= len(x):
        return sample(images[0], x, y)
    if cam0_count == 0:
        return sample(images[1], x, y)
    return np.concatenate(
        [sample(images[0], x[:cam0_count], y[:cam0_count]), sample(images[1], x[cam0_count:], y[cam0_count:])]
    )


def slant_evidence(patches: Patches, samples: F32, px_per_rho: F64) -> tuple[F64, F64]:
    """Return the information (N, 2, 2) of the slant of the patches' surfaces, and its product with the step
    (N, 2), for one gray level of noise.

    px_per_rho (N, 2): derivative of the position in the patch by inverse depth. samples (N, S): from `align`.
    The step is a change of d inverse depth / d px of the patch.
    """
    n = len(px_per_rho)
    by = np.zeros((n, 2, 4))  # derivative of the warp's linear part by the slant
    by[:, 0, 0::2] = by[:, 1, 1::2] = px_per_rho
    residual = ((patches.bend @ samples[:, :, None])[:, :, 0] - patches.at_rest) * patches.contrast[:, None]
    return by @ patches.rigid @ by.transpose(0, 2, 1), -(by @ residual[:, :, None])[:, :, 0]


def sample(image: U8, x: F32, y: F32) -> F32:
    """Return bilinear gray levels at places x, y (N, S)."""
    if len(x) > _MAX_REMAP_ROWS:
        parts = [slice(k, k + _MAX_REMAP_ROWS) for k in range(0, len(x), _MAX_REMAP_ROWS)]
        return np.concatenate([sample(image, x[part], y[part]) for part in parts])
    out: F32 = cv2.remap(
        image,
        np.ascontiguousarray(x),
        np.ascontiguousarray(y),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float32)
    return out


def sample_square(image: U8, px: F32, half: int) -> F32:
    """Return bilinear gray levels (N, (2 half + 1)^2) round px (N, 2), row by row."""
    dx, dy = _square_offsets(half)
    return sample(image, px[:, :1] + dx, px[:, 1:] + dy)


@lru_cache(maxsize=8)
def _square_offsets(half: int) -> tuple[F32, F32]:
    """Return x and y ((2 half + 1)^2,) px of the places in a square, row by row."""
    axis = np.arange(-half, half + 1, dtype=np.float32)
    dx, dy = np.meshgrid(axis, axis)
    return dx.ravel(), dy.ravel()


def _normalised(gray: F32) -> tuple[F32, F32]:
    """Return gray levels (N, S) of zero mean and unit norm, and the norm (N,)."""
    gray = gray - (gray @ _MEAN)[:, None]
    norm = np.sqrt(np.einsum("ns,ns->n", gray, gray))
    gray /= np.maximum(norm, _MIN_CONTRAST)[:, None]
    return gray, norm
