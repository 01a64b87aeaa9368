"""What a real sensor makes of a perfect picture: blur, noise, and depth like a D435i's."""

from __future__ import annotations

import cv2
import numpy as np

from share.types import F32, U8

_GRAY_SIGMA = 2.0  # gray levels
_DISPARITY_SIGMA = 0.1  # px
_DISPARITY_STEP = 1 / 32  # px; the stereo matcher's resolution
_HOLE = 2.3  # sigmas of smooth noise beyond which the matcher finds nothing
_OCCLUSION = 0.5  # px; a step in disparity that one of the two cameras looks past
_NEAREST, _FARTHEST = 0.28, 10.0  # m
_BANK = (1100, 1500)  # noise is drawn once and read at random places: drawing it anew costs 5 ms an image


class Sensor:
    """Noise of one agent's sensors. Frame and camera choose the noise, so order does not matter."""

    def __init__(self, seed: tuple[int, ...]) -> None:
        rng = np.random.default_rng(seed)
        self._seed = seed
        white = rng.normal(0, 1, _BANK).astype(np.float32)
        smooth = cv2.GaussianBlur(white, (0, 0), 2.0)
        self._gray = np.rint(white * _GRAY_SIGMA).astype(np.int16)
        self._smooth = smooth / smooth.std()

    def gray(self, image: U8, frame: int, camera: int) -> U8:
        """(H, W) uint8: lens blur (sigma 0.5 px) and additive noise."""
        (noise,) = self._read([self._gray], image.shape, (frame, camera))
        soft = cv2.GaussianBlur(image, (3, 3), 0.5)
        out: U8 = cv2.add(soft, noise, dtype=cv2.CV_8U)
        return out

    def depth_mm(self, depth: F32, focal_baseline: float, frame: int) -> np.ndarray:
        """(H, W) uint16 mm, 0 = no reading. focal_baseline: px m of the stereo pair that would measure it.

        Noise is white in disparity, so sigma_z = z^2 sigma_d / (f b); smooth over a few pixels, as
        block matching leaves it.
        """
        noise, gaps = self._read([self._smooth, self._smooth], depth.shape, (frame, 2))
        exact = focal_baseline / depth
        disparity = np.rint((exact + _DISPARITY_SIGMA * noise) / _DISPARITY_STEP) * _DISPARITY_STEP
        measured = focal_baseline / np.maximum(disparity, _DISPARITY_STEP)
        step = cv2.dilate(exact, _THREE) - cv2.erode(exact, _THREE)
        hole = (step > _OCCLUSION) | (gaps > _HOLE) | (measured < _NEAREST) | (measured > _FARTHEST)
        return np.where(hole, 0, measured * 1000 + 0.5).astype(np.uint16)

    def _read(
        self, banks: list[np.ndarray], shape: tuple[int, ...], key: tuple[int, ...]
    ) -> list[np.ndarray]:
        rng = np.random.default_rng((*self._seed, *key))
        out = []
        for bank in banks:
            top, left = rng.integers(
                0, [n - m for n, m in zip(bank.shape, shape, strict=True)], endpoint=True
            )
            out.append(bank[top : top + shape[0], left : left + shape[1]])
        return out


_THREE = np.ones((3, 3), np.uint8)
