"""Faults injected into frames: what changes, when, and that nothing else does."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.train.fault_injection import FAULT_KINDS, FaultInterval, draw_faults, inject_faults
from share.types import Frame, ImuBatch

S = 1_000_000_000
HZ = 10
FOCAL, BASELINE_M = 20.0, 0.05
LENS = Camera(64, 48, FOCAL, FOCAL, 32.0, 24.0)
RIG = Rig(LENS, np.eye(4), LENS, se3.exp(np.array([0, 0, 0, -BASELINE_M, 0, 0])))


def frames(seconds: float = 3.0) -> list[Frame]:
    """Textured stereo at 10 Hz, with two IMU samples each."""
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (48, 64), np.uint8)
    out = []
    for k in range(round(seconds * HZ)):
        stamp_ns = S + k * S // HZ
        stamps = np.array([stamp_ns - S // 20, stamp_ns])
        out.append(
            Frame(stamp_ns, k, image, image[:, ::-1], imu=ImuBatch(stamps, np.ones((2, 3)), np.ones((2, 3))))
        )
    return out


def during(kind: str, severity: float, begin_s: float = 2.0, end_s: float = 3.0) -> list[Frame]:
    return list(
        inject_faults(frames(), [FaultInterval(kind, round(begin_s * S), round(end_s * S), severity)], 1, RIG)
    )


@pytest.mark.parametrize("kind", ["dark", "blur", "haze", "cover"])
def test_images_are_degraded_during_a_fault_only(kind):
    for before, after in zip(frames(), during(kind, 0.7), strict=True):
        same = (before.image0 == after.image0).all() and (before.image1 == after.image1).all()
        assert same == (not 2 * S <= before.stamp_ns < 3 * S)
        assert len(after.imu) == 2


@pytest.mark.parametrize("kind", ["dark", "blur", "haze"])
def test_contrast_falls_with_severity(kind):
    contrast = [during(kind, severity)[15].image0.std() for severity in (0.1, 0.4, 0.7, 1.0)]
    assert contrast == sorted(contrast, reverse=True)
    assert contrast[-1] < 0.2 * contrast[0]


def test_an_occluder_hides_a_third_to_nearly_all():
    seen = frames()[15].image0
    for severity, hidden in ((0.0, 0.33), (1.0, 0.98)):
        covered = during("cover", severity)[15].image0
        assert (covered != seen).mean() == pytest.approx(hidden, abs=0.05)


def test_an_occluder_is_near_in_stereo_and_in_depth():
    for away, away_m in ((0.0, 0.1), (1.0, 0.5)):
        fault = FaultInterval("cover", S, 2 * S, 0.2, (0.7, 0.5, away))
        (whole,) = (replace(frame, depth=np.ones((24, 32), np.float32)) for frame in frames(0.1))
        (seen,) = inject_faults([whole], [fault], 1, RIG)
        assert seen.image1 is not None and seen.depth is not None and whole.image1 is not None
        left, right = (
            np.flatnonzero((a != b).mean(axis=0) > 0.5)
            for a, b in zip((whole.image0, whole.image1), (seen.image0, seen.image1), strict=True)
        )
        assert left[0] - right[0] == pytest.approx(FOCAL * BASELINE_M / away_m, abs=1)
        assert len(left) == len(right)
        near = set(np.unique(seen.depth))
        assert near == {0.0, 1.0} if away_m < 0.28 else near == {np.float32(away_m), 1.0}


def test_imu_samples_of_dropped_frames_come_with_the_next():
    given = during("drop", 1.0)
    assert [frame.index for frame in given] == [*range(10), *range(20, 30)]
    late = given[10]
    assert len(late.imu) == 22
    assert (np.diff(late.imu.stamps_ns) > 0).all()
    assert late.gap_ns == S
    assert {frame.gap_ns for frame in given if frame is not late} == {0}


def test_an_imu_that_is_missing_gives_no_samples():
    counts = [len(frame.imu) for frame in during("imu_missing", 0.5)]
    assert counts == [2] * 10 + [0] * 10 + [2] * 10


def test_the_same_seed_gives_the_same_faults():
    faults = [FaultInterval("dark", S, 4 * S, 0.5)]
    one, two, other = (list(inject_faults(frames(), faults, seed, RIG)) for seed in (1, 1, 2))
    assert all((a.image0 == b.image0).all() for a, b in zip(one, two, strict=True))
    assert any((a.image0 != b.image0).any() for a, b in zip(one, other, strict=True))


def test_faults_are_drawn_within_the_run_and_of_all_severities(rng):
    faults = draw_faults(rng, 0, 3000 * S, FAULT_KINDS)
    assert {fault.kind for fault in faults} == set(FAULT_KINDS)
    for kind in FAULT_KINDS:
        mine = [fault for fault in faults if fault.kind == kind]
        assert mine[0].begin_ns >= 2 * S
        assert all(a.end_ns < b.begin_ns for a, b in pairwise(mine))
        assert all(1.0 <= (fault.end_ns - fault.begin_ns) / S <= 8.0 for fault in mine)
        assert min(fault.severity for fault in mine) < 0.1 < 0.9 < max(fault.severity for fault in mine)
