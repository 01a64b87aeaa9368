"""Features of a keyframe that never was."""

from __future__ import annotations

import numpy as np

from share.odometry.error_model.features import SHAPES, Features, kind_of


def made_features(rng: np.random.Generator, **given: np.ndarray) -> Features:
    """Drawn, but for what is given."""
    drawn = {
        name: rng.integers(0, 256, shape, np.uint8)
        if kind_of(name) is np.uint8
        else rng.random(shape, np.float32)
        for name, shape in SHAPES.items()
    }
    return Features(**drawn | given)
