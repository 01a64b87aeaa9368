"""What a feature looks like: the patch round it in the image that saw it first, and finding it again to a
tenth of a pixel.

Every later image is compared with that first patch, so that tracks do not creep. Inverse-compositional
alignment (Baker & Matthews 2004): derivatives are the patch's own, made once; the patch is warped as its
place in the room predicts, which leaves a shift to be found. Gain and bias of the light do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from share.columns import Columns
from share.types import F32, F64, U8

HALF = 5  # px; patches are 11 x 11
_SIDE = 2 * HALF + 1
_AXIS = np.arange(-HALF, HALF + 1, dtype=np.float32)
OFFSETS: F32 = np.stack(np.meshgrid(_AXIS, _AXIS), axis=-1).reshape(-1, 2)  # (S, 2) px, x and y
_MEAN: F32 = np.full(_SIDE**2, 1 / _SIDE**2, np.float32)
_FLAT = 1e-3  # gray levels: a patch with less contrast is nothing
_MOST_ROWS = 30_000  # of what cv2.remap gives at a time (SHRT_MAX)


@dataclass(frozen=True, eq=False)
class Patches(Columns):
    """N patches of S samples. contrast (N,): the norm that gray levels had; inverse (N, 2, 2): of the normal
    matrix of their derivatives. probe (N, 3, S): `gray`, and what gives the shift: times samples of zero mean
    and unit norm, how alike they are and how far off, px. bend (N, 4, S): gray levels that come of a patch's
    sides moving apart, less what a shift explains: along x the more, the further right and the further down
    in it, then along y. rigid (N, 4, 4): products of these with each other; at_rest (N, 4): with `gray`."""

    contrast: F32
    inverse: F32
    probe: F32
    bend: F32
    rigid: F32
    at_rest: F32

    def __len__(self) -> int:
        return len(self.probe)

    @property
    def gray(self) -> F32:
        """(N, S) zero mean, unit norm."""
        return self.probe[:, 0]

    @property
    def sigma_px(self) -> F32:
        """(N,) error of a shift for one gray level of noise, in the worse direction."""
        out: F32 = np.sqrt(np.linalg.eigvalsh(self.inverse)[:, 1])
        return out


def empty() -> Patches:
    s = len(OFFSETS)
    shapes = ((0,), (0, 2, 2), (0, 3, s), (0, 4, s), (0, 4, 4), (0, 4))
    return Patches(*(np.zeros(shape, np.float32) for shape in shapes))


def cut(image: U8, px: F32) -> Patches:
    """The patches round px (N, 2)."""
    if len(px) == 0:
        return empty()
    wide = np.arange(-HALF - 1, HALF + 2, dtype=np.float32)
    x, y = np.meshgrid(wide, wide)
    grown = sample(image, px[:, :1] + x.ravel(), px[:, 1:] + y.ravel())
    grown = grown.reshape(-1, _SIDE + 2, _SIDE + 2)
    dx = (grown[:, 1:-1, 2:] - grown[:, 1:-1, :-2]) / 2
    dy = (grown[:, 2:, 1:-1] - grown[:, :-2, 1:-1]) / 2
    slope = np.stack([dx, dy], axis=1).reshape(len(px), 2, -1)
    gray, contrast = _normed(grown[:, 1:-1, 1:-1].reshape(len(px), -1))
    slope = slope - slope.mean(axis=2, keepdims=True)
    slope = slope - (slope @ gray[:, :, None]) * gray[:, None, :]
    normal = slope @ slope.transpose(0, 2, 1) + np.float32(1e-3) * np.eye(2, dtype=np.float32)
    inverse = np.linalg.inv(normal)
    probe = np.concatenate([gray[:, None], contrast[:, None, None] * (inverse @ slope)], axis=1)
    bend = (slope[:, :, None] * OFFSETS.T).reshape(len(px), 4, -1)
    bend -= bend.mean(axis=2, keepdims=True)
    bend -= bend @ slope.transpose(0, 2, 1) @ inverse @ slope
    at_rest = (bend @ gray[:, :, None])[:, :, 0]
    return Patches(contrast, inverse, probe, bend, bend @ bend.transpose(0, 2, 1), at_rest)


@dataclass(frozen=True, eq=False)
class Found:
    """px (N, 2) where the patches are; alike (N,): normalised correlation there, 1 at best; step (N,): px
    of the last correction, small where it settled. samples (N, S): what was last seen, zero mean, unit
    norm."""

    px: F32
    alike: F32
    step: F32
    samples: F32


def align(
    images: tuple[U8, ...],
    first: int,
    probe: F32,
    px: F64,
    warp: F64,
    most: int = 4,
    settled_px: float = 0.02,
) -> Found:
    """From px (N, 2), the patches, of which probe (N, 3, S) tells, being warped by (N, 2, 2): d px here /
    d px there. At most `most` steps.
    The first so many are sought in the first of one or two images, the others in the second."""
    n, every = len(probe), probe
    at, W = px.astype(np.float32), warp.astype(np.float32)
    alike, step = np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
    samples = np.zeros((n, len(OFFSETS)), np.float32)
    x, y = W[:, 0] @ OFFSETS.T, W[:, 1] @ OFFSETS.T
    todo = np.arange(n)
    for _ in range(most):
        if len(todo) == 0:
            break
        if len(todo) < n:
            probe, X, Y = every[todo], x[todo], y[todo]
        else:
            X, Y = x, y
        here = at[todo]
        seen = _sampled(images, int(np.searchsorted(todo, first)), X + here[:, :1], Y + here[:, 1:])
        seen, _ = _normed(seen)
        told = np.einsum("nks,ns->nk", probe, seen)
        alike[todo], samples[todo] = told[:, 0], seen
        move = np.einsum("nij,nj->ni", W[todo], told[:, 1:])
        at[todo] -= move
        far = np.hypot(move[:, 0], move[:, 1])
        step[todo] = far
        todo = todo[(far > settled_px) & np.isfinite(far)]
    return Found(at, alike, step, samples)


def _sampled(images: tuple[U8, ...], first: int, x: F32, y: F32) -> F32:
    """Gray levels (N, S), of the first so many in the first image."""
    if first >= len(x):
        return sample(images[0], x, y)
    if first == 0:
        return sample(images[1], x, y)
    return np.concatenate([sample(images[0], x[:first], y[:first]), sample(images[1], x[first:], y[first:])])


def slanted(patches: Patches, samples: F32, along: F64) -> tuple[F64, F64]:
    """What patches say of the slant of their surfaces: information (N, 2, 2) and its product with the step
    (N, 2), for one gray level of noise. along (N, 2): px of the patch by which its middle moves for one
    unit more of inverse depth; the step is the change of inverse depth by px of the patch. samples (N, S):
    what `align` saw last."""
    n = len(along)
    by = np.zeros((n, 2, 4))  # of px across and px down, through px along x and y
    by[:, 0, 0::2] = by[:, 1, 1::2] = along
    error = ((patches.bend @ samples[:, :, None])[:, :, 0] - patches.at_rest) * patches.contrast[:, None]
    return by @ patches.rigid @ by.transpose(0, 2, 1), -(by @ error[:, :, None])[:, :, 0]


def sample(image: U8, x: F32, y: F32) -> F32:
    """Bilinear gray levels at (N, S) places."""
    if len(x) > _MOST_ROWS:
        parts = [slice(k, k + _MOST_ROWS) for k in range(0, len(x), _MOST_ROWS)]
        return np.concatenate([sample(image, x[part], y[part]) for part in parts])
    out: F32 = cv2.remap(
        image,
        np.ascontiguousarray(x),
        np.ascontiguousarray(y),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float32)
    return out


def _normed(gray: F32) -> tuple[F32, F32]:
    """Zero mean, unit norm (N, S), and the norm (N,)."""
    gray = gray - (gray @ _MEAN)[:, None]
    norm = np.sqrt(np.einsum("ns,ns->n", gray, gray))
    gray /= np.maximum(norm, _FLAT)[:, None]
    return gray, norm
