"""Label files."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.made_features import made_features

from share.errors import DataError
from share.lab.train.labels import Labels, read_labels, write_labels
from share.odometry.error_model.inputs import INPUT_SHAPES


@pytest.fixture
def labels(rng) -> Labels:
    rows = [
        (
            10**18 + k,
            float("nan") if k == 0 else 0.1 * k,
            made_features(rng),
        )
        for k in range(4)
    ]
    return Labels.from_rows({"session": "w1", "agent": "ar", "faults": []}, rows)


def test_written_labels_are_read(labels, tmp_path):
    write_labels(tmp_path / "one.npz", labels)
    found = read_labels(tmp_path / "one.npz")
    assert found.about == labels.about
    assert len(found) == 4
    for name in ("stamps_ns", "error_cm", *INPUT_SHAPES):
        one, two = getattr(labels, name), getattr(found, name)
        assert one.dtype == two.dtype
        assert np.array_equal(one, two, equal_nan=name == "error_cm")


def test_a_damaged_file_is_named(labels, tmp_path):
    path = tmp_path / "one.npz"
    write_labels(path, labels)
    whole = path.read_bytes()
    for data in (b"", b"text", whole[: len(whole) // 2]):
        path.write_bytes(data)
        with pytest.raises(DataError, match=r"one\.npz: not a label file, or damaged"):
            read_labels(path)


def test_a_run_without_keyframes_is_written_and_read(tmp_path):
    write_labels(tmp_path / "none.npz", Labels.from_rows({"session": "w1"}, []))
    assert len(read_labels(tmp_path / "none.npz")) == 0
