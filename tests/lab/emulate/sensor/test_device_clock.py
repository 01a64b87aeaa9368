import numpy as np
import pytest

from share.lab.emulate.sensor.clock import (
    DeviceClock,
    SampleStream,
    dropped_mask,
    normal,
    stamp_jitter_ns,
    uniform,
)
from share.sensors.stamps import unwrap_stamps


def test_a_stream_keeps_its_rate_and_is_the_same_in_every_span():
    stream = SampleStream(30.0, 10**18 + 7)
    index, true = stream.sample_times(10**18, 10**18 + 3600 * 10**9)
    assert len(index) == 108_000
    assert true[0] == 10**18 + 7
    assert np.abs(true - (true[0] + index * 1e9 / 30)).max() < 200  # float64 spacing near 1e18 is 128
    part, at = stream.sample_times(int(true[500]), int(true[800]))
    assert np.array_equal(part, np.arange(500, 801))
    assert np.array_equal(at, true[500:801])
    assert len(stream.sample_times(0, 10**9)[0]) == 0


def test_the_clock_gains_its_drift_and_wraps_at_32_bits_of_microseconds():
    true = 10**18 + np.arange(0, 10_000 * 10**9, 10**9)
    clock = DeviceClock(10**18, offset_ns=5_000_000, drift_ppm=20.0, tick_ns=1000)
    shown = clock.read(true)
    assert shown[0] - true[0] == 5_000_000
    assert shown[-1] - true[-1] == 5_000_000 + 9_999 * 20_000
    assert (shown % 1000 == 0).all()
    wrapped = DeviceClock(10**18, 5_000_000, 20.0, 1000, 32).read(true)
    assert (wrapped < 2**32 * 1000).all() and (np.diff(wrapped) < 0).sum() in (2, 3)
    counted = unwrap_stamps(wrapped, 2**32 * 1000)
    assert np.array_equal(np.diff(counted), np.diff(shown))


@pytest.mark.parametrize(("share", "burst"), [(0.02, 1.0), (0.1, 1.0), (0.1, 4.0), (0.5, 3.0)])
def test_frames_drop_at_the_rate_and_in_the_bursts_asked_for(share: float, burst: float):
    lost = dropped_mask((3,), np.arange(200_000), share, burst)
    assert abs(lost.mean() / share - 1) < 0.05
    runs = lost.sum() / (np.diff(lost.astype(int)) == 1).sum()
    alone = burst / (1 - share)  # bursts that touch or overlap make longer ones
    assert burst * 0.95 < runs < alone * 1.6
    assert np.array_equal(dropped_mask((3,), np.arange(70_000, 70_100), share, burst), lost[70_000:70_100])
    assert not dropped_mask((3,), np.arange(100), 0.0, 1.0).any()


def test_jitter_has_its_sigma_and_never_lets_stamps_overtake():
    error = stamp_jitter_ns((1,), np.arange(50_000), 1e6, 30.0)
    assert abs(error.std() / 1e6 - 1) < 0.03
    wild = stamp_jitter_ns((1,), np.arange(50_000), 20e6, 30.0)
    assert (np.diff(np.arange(50_000) * 1e9 / 30 + wild) > 0).all()


def test_a_random_number_depends_on_its_index_alone():
    whole = uniform((7,), np.arange(10_000))
    some = np.array([9_999, 3, 5_000, 3])
    assert np.array_equal(uniform((7,), some), whole[some])
    assert np.array_equal(normal((7,), some), normal((7,), np.arange(10_000))[some])


def test_random_numbers_are_uniform_or_normal_and_depend_on_the_seed():
    u, n = uniform((1, 2), np.arange(100_000)), normal((1, 2), np.arange(100_000))
    assert u.min() >= 0 and u.max() < 1 and abs(u.mean() - 0.5) < 0.005
    assert abs(n.mean()) < 0.01 and abs(n.std() - 1) < 0.01
    assert abs(np.corrcoef(n[:-1], n[1:])[0, 1]) < 0.01
    assert not np.isin(uniform((1, 3), np.arange(1000)), u[:1000]).any()
