"""The peak of a curve between its samples."""

import numpy as np
import pytest

from share.geometry.interpolation import subsample_peak


@pytest.mark.parametrize("top", [-0.4, 0.0, 0.3])
def test_the_peak_of_a_parabola_is_exact(top):
    assert subsample_peak(-((np.arange(5) - 2 - top) ** 2), 2) == pytest.approx(top)


def test_the_peak_at_an_end_or_a_convex_place_is_the_sample():
    assert subsample_peak(np.array([3.0, 2.0, 1.0]), 0) == 0
    assert subsample_peak(np.array([1.0, 1.0, 1.0]), 1) == 0
    assert subsample_peak(np.array([1.0, 0.0, 1.0]), 1) == 0
