"""A view in 38 bytes a feature, to keep in memory and in the map file."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from share.checks import MAX_POSITION_M, checked_array
from share.geometry.camera import rays
from share.types import DESCRIPTOR_BYTES, F64, MAX_KEYPOINTS, MAX_UV, U8, View

_STEPS = 32767  # of a coordinate, to either side


@dataclass(frozen=True, eq=False)
class PackedView:
    """ORB features of a keyframe's image.

    uv (N, 2) int16: normalised coordinates, in steps of uv_step: 1/80 px of a usual camera. rho (N,) float16:
    inverse depths, 1/m, exact to 0.05 %; NaN where unknown. descriptors (N, 32) uint8.
    """

    uv: NDArray[np.int16]
    uv_step: float
    rho: NDArray[np.float16]
    descriptors: U8

    def __post_init__(self) -> None:
        n = len(self.uv)
        if n > MAX_KEYPOINTS:
            raise ValueError(f"uv: {n} keypoints, at most {MAX_KEYPOINTS}")
        if not 0 <= self.uv_step * _STEPS <= MAX_UV * 1.001:
            raise ValueError(f"uv_step: {self.uv_step} is outside 0 .. {MAX_UV / _STEPS:g}")
        fields = {
            "uv": checked_array("uv", self.uv, (n, 2), np.int16),
            "rho": checked_array("rho", self.rho, (n,), np.float16, finite=False),
            "descriptors": checked_array("descriptors", self.descriptors, (n, DESCRIPTOR_BYTES), np.uint8),
        }
        for name, array in fields.items():
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.uv)

    @property
    def nbytes(self) -> int:
        return self.uv.nbytes + self.rho.nbytes + self.descriptors.nbytes

    @staticmethod
    def pack(view: View) -> PackedView:
        step = float(np.abs(view.uv).max(initial=0.0)) / _STEPS
        uv = np.rint(view.uv.astype(np.float64) / (step or 1.0)).astype(np.int16)
        with np.errstate(divide="ignore", over="ignore"):
            rho = (1 / view.points[:, 2].astype(np.float64)).astype(np.float16)
        return PackedView(uv, step, np.where(np.isfinite(rho) & (rho > 0), rho, np.nan), view.descriptors)

    def unpack(self) -> View:
        """Return the view; points that are too far for one have no depth."""
        uv: F64 = self.uv.astype(np.float64) * self.uv_step
        rho = self.rho.astype(np.float64)
        points = (
            rays(uv) / np.where(rho * MAX_POSITION_M > np.abs(rays(uv)).max(axis=1), rho, np.nan)[:, None]
        )
        return View(uv.astype(np.float32).clip(-MAX_UV, MAX_UV), points.astype(np.float32), self.descriptors)

    def to_bytes(self) -> bytes:
        arrays = self.uv.astype("<i2"), self.rho.astype("<f2"), self.descriptors
        return msgspec.msgpack.encode((self.uv_step, *(array.tobytes() for array in arrays)))

    @staticmethod
    def from_bytes(data: bytes) -> PackedView:
        """Raises ValueError if they are not those of a view."""
        uv_step, uv, rho, descriptors = _decode(data)
        return PackedView(
            np.frombuffer(uv, "<i2").reshape(-1, 2),
            uv_step,
            np.frombuffer(rho, "<f2"),
            np.frombuffer(descriptors, np.uint8).reshape(-1, DESCRIPTOR_BYTES),
        )


_decode = msgspec.msgpack.Decoder(tuple[float, bytes, bytes, bytes]).decode
