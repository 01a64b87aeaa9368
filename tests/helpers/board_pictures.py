"""Pictures of a calibration board as a pinhole camera takes them, without a renderer."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from share.lab.calibrate.target import Target
from share.lab.calibrate.target_sheet import black_rectangles, darkness_image
from share.types import F64, U8

_TEXEL, _MARGIN = 0.001, 0.04  # m
_FINE = np.array([[3, 0, 1], [0, 3, 1], [0, 0, 1]])  # to pixels a third as large: edges without steps
PAPER = 220


@dataclass(frozen=True, eq=False)
class Printed:
    """A picture of a board, and what takes (x, y, 1) m on it to pixels there."""

    picture: U8
    to_texels: F64

    def seen(self, K: F64, T_cam_target: F64, size: tuple[int, int]) -> U8:
        """By a camera of images (width, height) without distortion."""
        H = _FINE @ K @ T_cam_target[:3, [0, 1, 3]] @ np.linalg.inv(self.to_texels)
        large = (3 * size[0], 3 * size[1])
        fine = cv2.warpPerspective(self.picture, H, large, borderValue=PAPER)
        return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), np.uint8)


def printed(board: Target) -> Printed:
    low, high = board.extent[0] - _MARGIN, board.extent[1] + _MARGIN
    columns, rows = np.round((high - low) / _TEXEL).astype(int)
    xs, ys = low[0] + _TEXEL * np.arange(columns + 1), high[1] - _TEXEL * np.arange(rows + 1)
    shift = (-low[0] / _TEXEL - 0.5, high[1] / _TEXEL - 0.5)
    to_texels = np.array([[1 / _TEXEL, 0, shift[0]], [0, -1 / _TEXEL, shift[1]], [0, 0, 1]])
    return Printed(
        np.round(PAPER - 190 * darkness_image(black_rectangles(board), xs, ys)).astype(np.uint8), to_texels
    )
