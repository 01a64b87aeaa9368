"""The top of a curve between its steps."""

import numpy as np
import pytest

from share.geometry.interpolation import subsample_peak


@pytest.mark.parametrize("top", [-0.4, 0.0, 0.3])
def test_of_a_parabola_it_is_exact(top):
    assert subsample_peak(-((np.arange(5) - 2 - top) ** 2), 2) == pytest.approx(top)


def test_at_an_end_and_where_nothing_bends_down_it_is_the_step_itself():
    assert subsample_peak(np.array([3.0, 2.0, 1.0]), 0) == 0
    assert subsample_peak(np.array([1.0, 1.0, 1.0]), 1) == 0
    assert subsample_peak(np.array([1.0, 0.0, 1.0]), 1) == 0
