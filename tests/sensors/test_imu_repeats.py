"""Samples that only repeat the ones before are no measurements; chance repeats are."""

from __future__ import annotations

import numpy as np
import pytest

from share.config import SequencerConfig
from share.sensors.imu_repeats import ImuRepeats
from share.sensors.measurement import Measurement
from share.sensors.sequencer import FrameMerger, SequencerCounters, sequence_frames

STEP_NS = 5_000_000


def measured(count: int = 400) -> np.ndarray:
    return np.random.default_rng(4).normal(0, 0.01, (count, 6)) + np.eye(6)[5] * 9.81


def dropped(values: np.ndarray, frame: int) -> list[int]:
    repeats = ImuRepeats()
    valid = [repeats.valid_mask(values[k : k + frame]) for k in range(0, len(values), frame)]
    out = np.flatnonzero(~np.concatenate(valid)).tolist()
    assert repeats.count == len(out)
    return out


@pytest.mark.parametrize("frame", [1, 2, 7, 400])
def test_from_the_third_equal_sample_on_none_is_accepted(frame: int) -> None:
    values = measured()
    values[100:160] = values[100]
    assert dropped(values, frame) == list(range(102, 160))


@pytest.mark.parametrize("frame", [1, 7, 400])
def test_zeros_are_dropped_at_once(frame: int) -> None:
    values = measured()
    values[:5] = values[300:] = 0.0
    assert dropped(values, frame) == [*range(5), *range(300, 400)]


def test_a_driver_that_asks_twice_as_often_and_one_axis_that_is_clipped_lose_nothing() -> None:
    values = measured().repeat(2, axis=0)
    assert dropped(values, 7) == []
    clipped = measured()
    clipped[:, 0] = 8.7
    assert dropped(clipped, 7) == []


def test_samples_not_finite_are_no_repeats() -> None:
    assert dropped(np.full((10, 6), np.nan), 3) == []  # the range check drops them


def test_frames_of_a_stuck_imu_are_silent() -> None:
    values = measured()
    values[200:] = values[200]
    samples = [Measurement("imu", k * STEP_NS, tuple(row)) for k, row in enumerate(values)]
    images = [Measurement("cam0", k * 10 * STEP_NS, f"image {k}") for k in range(len(values) // 10)]
    counters = SequencerCounters()
    merger = FrameMerger(("cam0", "imu"), 20.0, SequencerConfig(), counters)
    in_order = sorted([*samples, *images], key=lambda m: m.stamp_ns)
    frames = list(sequence_frames(in_order, merger))
    assert [len(f.imu) for f in frames] == [1] + 20 * [10] + [1] + 18 * [0]
    assert (counters.imu_repeated, counters.imu_silent, counters.imu_samples) == (189, 18, 202)
