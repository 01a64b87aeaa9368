"""`share train labels`."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from share.lab.train.labels import read_labels
from share.metrics.local_error import LocalError
from share.odometry.error_model.inputs import RECENT_NAMES


@pytest.mark.slow
def test_labels_of_a_session(share, plain_session, tmp_path):
    out = tmp_path / "labels"
    arguments = ("train", "labels", plain_session, "--runs", 2, "--workers", 1, "--out", out)
    done = share(*arguments)
    assert done.code == 0, done.err
    assert done.err == ""
    assert done.out.startswith("6 runs, ")
    assert len(list(out.iterdir())) == 6
    (clean,) = (path for path in out.iterdir() if path.name.endswith("ar1-0.npz"))
    labels = read_labels(clean)
    assert labels.about["faults"] == []
    assert labels.about["agent"] == "ar1"
    known = np.isfinite(labels.error_cm)
    assert not known[labels.stamps_ns < labels.stamps_ns[0] + 2.4e9].any()  # half a window first
    assert (labels.error_cm[known] < 1).all()
    assert labels.about["imu"] and not labels.recent[:, RECENT_NAMES.index("no IMU")].any()

    assert share(*arguments, "--without-imu").code == 0  # beside the others
    bare = read_labels(out / clean.name.replace("-0", "-without-imu-0"))
    assert not bare.about["imu"] and bare.recent[:, RECENT_NAMES.index("no IMU")].all()
    assert np.nanmedian(bare.error_cm) < 2

    made = {path: path.stat().st_mtime_ns for path in out.iterdir() if "without" not in path.name}
    next(iter(made)).unlink()
    assert share(*arguments).code == 0  # goes on where it was broken off
    assert sum(path.stat().st_mtime_ns == was for path, was in made.items()) == 5

    other = share(*arguments[:-2], "--seed", 1, "--out", out)
    assert other.code == 2
    assert "is of seed 0; give another --out" in other.err


def test_session_without_ground_truth_is_refused(share, plain_session, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in plain_session.glob("*.*"):
        shutil.copy(path, bare)
    done = share("train", "labels", bare, "--out", tmp_path / "labels")
    assert done.code == 2
    assert "has no ground truth truth/ar1.tum, which labels need" in done.err
    assert not (tmp_path / "labels").exists()


@pytest.mark.slow
def test_labels_are_the_errors_of_the_run(share, plain_session, tmp_path):
    """As `share track` and the truth give them, frame by frame."""
    from share.recordings.trajectory import read_tum
    from share.runtime.source import open_source

    out = tmp_path / "labels"
    assert share("train", "labels", plain_session, "--runs", 1, "--out", out).code == 0
    for agent in ("ar1", "ar2", "robot"):
        tum = tmp_path / f"{agent}.tum"
        assert share("track", f"{plain_session}/{agent}", "--out", tum).code == 0
        (path,) = out.glob(f"*-{agent}-0.npz")
        labels, told = read_labels(path), read_tum(tum)
        error = LocalError(open_source(f"{plain_session}/{agent}").truth())
        errors = {int(ns): error.update(int(ns), T) for ns, T in zip(told.stamps_ns, told.T, strict=True)}
        wanted = [np.nan if errors[int(ns)] is None else errors[int(ns)] for ns in labels.stamps_ns]
        assert labels.error_cm == pytest.approx(wanted, abs=1e-3, nan_ok=True)
