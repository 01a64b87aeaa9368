"""Features of a keyframe that never was."""

from __future__ import annotations

import numpy as np

from share.odometry.error_model.inputs import INPUT_SHAPES, ErrorModelInput, input_dtype


def made_features(rng: np.random.Generator, **given: np.ndarray) -> ErrorModelInput:
    """Drawn, but for what is given."""
    drawn = {
        name: rng.integers(0, 256, shape, np.uint8)
        if input_dtype(name) is np.uint8
        else rng.random(shape, np.float32)
        for name, shape in INPUT_SHAPES.items()
    }
    return ErrorModelInput(**drawn | given)
