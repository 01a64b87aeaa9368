"""Gray levels are sampled at many positions."""

from __future__ import annotations

import numpy as np

from share.vision.patches import sample


def test_sampling_exceeds_the_row_limit_of_opencv(rng: np.random.Generator) -> None:
    image = rng.integers(0, 255, (40, 50), dtype=np.uint8)
    x, y = (rng.uniform(0, side - 1, (70_000, 3)).astype(np.float32) for side in (50, 40))
    seen = sample(image, x, y)
    assert seen.shape == (70_000, 3)
    for k in (0, 29_999, 30_000, 69_999):
        assert np.array_equal(seen[k : k + 1], sample(image, x[k : k + 1], y[k : k + 1]))
