"""Views in 38 bytes a feature."""

from __future__ import annotations

import numpy as np
import pytest

from share.types import View
from share.vision.packed_view import PackedView


def view(n: int = 200) -> View:
    rng = np.random.default_rng(0)
    uv = rng.uniform(-0.9, 0.9, (n, 2))
    points = np.column_stack([uv, np.ones(n)]) * rng.uniform(0.3, 40, (n, 1))
    points[::7] = np.nan
    return View(uv.astype(np.float32), points.astype(np.float32), rng.integers(0, 256, (n, 32), np.uint8))


def test_a_view_is_kept_to_a_fraction_of_a_pixel() -> None:
    before = view()
    packed = PackedView.from_bytes(PackedView.pack(before).to_bytes())
    after = packed.unpack()
    assert packed.nbytes == 38 * len(before)
    assert np.array_equal(after.descriptors, before.descriptors)
    assert np.abs(after.uv - before.uv).max() * 500 < 0.01  # px at a focal length of 500
    assert np.array_equal(np.isnan(after.points), np.isnan(before.points))
    known = ~np.isnan(before.points[:, 2])
    assert after.points[known] == pytest.approx(before.points[known], rel=1.2e-3, abs=1e-3)


def test_what_was_unpacked_packs_the_same() -> None:
    once = PackedView.pack(view())
    assert np.array_equal(PackedView.pack(once.unpack()).rho, once.rho, equal_nan=True)


def test_an_empty_view() -> None:
    packed = PackedView.from_bytes(PackedView.pack(View.empty()).to_bytes())
    assert len(packed) == len(packed.unpack()) == 0


def test_points_without_a_sensible_depth_have_none() -> None:
    points = np.array([[0, 0, 0], [0, 0, -1], [0, 0, 9e4], [0, 0, np.nan], [0, 0, 1e-9]], np.float32)
    bad = View(np.zeros((5, 2), np.float32), points, np.zeros((5, 32), np.uint8))
    known = np.isfinite(PackedView.pack(bad).unpack().points).all(axis=1)
    assert not known[[0, 1, 3, 4]].any()


@pytest.mark.parametrize(
    "data",
    [b"", b"\xc1", PackedView.pack(view(3)).to_bytes()[:-1], PackedView.pack(view(3)).to_bytes() + b"\0"],
)
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        PackedView.from_bytes(data)


def test_columns_of_different_lengths_are_refused() -> None:
    packed = PackedView.pack(view(4))
    with pytest.raises(ValueError, match="rho"):
        PackedView(packed.uv, packed.uv_step, packed.rho[:2], packed.descriptors)
    with pytest.raises(ValueError, match="uv_step"):
        PackedView(packed.uv, float("nan"), packed.rho, packed.descriptors)
