"""The filter in a simulated world: consistent covariances, and online calibration."""

import numpy as np
import pytest
from helpers.imu_simulation import SHIPPED, Setup, run

from share.odometry.state import CORE_SIZE, EXTRINSIC

MISSES = pytest.mark.xfail(
    strict=True,
    reason="what lasts in a pixel's error is white to the filter: see docs/understand/odometry.md",
)
BANDS = {6: (1.37, 5.04), 50: (2.36, 3.72)}  # of the mean of N chi-square values, 3 dof, 95 %


def nees(seeds, setup):
    """Mean over runs and the seconds from 1 on, of orientation and position: with z up, then in odom."""
    runs = [run(seed, setup) for seed in range(seeds)]
    return np.mean([np.r_[r.nees[20:].mean(axis=0), r.nees_in_odom[20:].mean(axis=0)] for r in runs], axis=0)


@pytest.mark.long
@pytest.mark.parametrize("mono", [False, True])
def test_nees(mono):
    low, high = BANDS[6]
    found = nees(6, Setup(seconds=6.0, mono=mono))
    assert (low < found).all()
    assert (found < high).all()


@pytest.mark.slow
def test_nees_in_odom_of_a_body_that_began_tilted():
    """By two degrees, and a bias as unknown: the motion since then is as sure as is told, without the tilt,
    which is most of what a pose with z up is unsure of."""
    runs = [run(seed, Setup(pose=(0.035, 1e-4), ba=0.3)) for seed in range(9100, 9150)]
    low, high = BANDS[50]
    for k in (100, 200, 398):
        orientation, position = np.mean([r.nees_in_odom[k] for r in runs], axis=0)
        upright, _ = np.mean([r.nees[k] for r in runs], axis=0)
        print(k / 20, orientation, position, upright)
        assert low < position < high
        assert low < orientation < high + 0.2  # 3.9 at most: what lasts in a pixel's error
        assert orientation < 0.8 * upright  # whose tilt is told too well, 5 to 6


@pytest.mark.parametrize("mono", [pytest.param(False, marks=MISSES), True])  # 2.2 at 2 s, 3.8 at 20 s
@pytest.mark.slow
def test_nees_of_fifty_runs(mono):
    """At 2, 5, 10 and 20 s, not over time, for errors of one run last. A single camera's first depths are so
    unsure that slopes do not hold for them: 5 at 2 s."""
    runs = [run(seed, Setup(mono=mono)) for seed in range(50)]
    low, high = BANDS[50]
    for k in (100, 200, 398) if mono else (40, 100, 200, 398):
        orientation, position = np.mean([r.nees[k] for r in runs], axis=0)
        print(k / 20, orientation, position)
        assert low < orientation < high
        assert low < position < high


@MISSES  # too unsure: 1.6 to 2.4 of position where 2.36 is the least
@pytest.mark.slow
@pytest.mark.parametrize(("phase", "white"), [(0.37, 0.0), (0.37, 1.0), (0.8, 3.0)])
def test_nees_between_samples_and_with_noise(phase, white):
    """Images between samples of the IMU; white shaking, m/s^2 and 0.03 rad/s for each of it."""
    runs = [run(seed, Setup(phase=phase, white=white)) for seed in range(50)]
    low, high = BANDS[50]
    for k in (40, 100, 200, 398):
        orientation, position = np.mean([r.nees[k] for r in runs], axis=0)
        print(k / 20, orientation, position)
        assert low < position < high
        assert orientation < high


@pytest.mark.slow
@pytest.mark.parametrize("machine", [1.0, 4.0])
def test_nees_under_vibration(machine):
    """If samples follow a vibration, an integral loses more than `shaken` knows: it is less sure
    than it could be, of its orientation."""
    runs = [run(seed, Setup(phase=0.37, imu_hz=400.0, machine=machine)) for seed in range(50)]
    for k in (40, 100, 200, 398):
        orientation, position = np.mean([r.nees[k] for r in runs], axis=0)
        print(k / 20, orientation, position)
        assert max(orientation, position) < BANDS[50][1]


def wrong(seed, sigma):
    """3 degrees, 3 cm and 10 ms in some direction; the filter expects `sigma` times as much."""
    rng = np.random.default_rng(seed)
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    error = np.concatenate([turn * np.radians(3), shift * 0.03])
    each = sigma / np.sqrt(3)
    return Setup(
        seconds=30.0,
        turn=np.radians(3) * each + 1e-6,
        shift=0.03 * each + 1e-6,
        offset=0.01 * sigma + 1e-7,
        extrinsic_error=error,
        offset_error=float(rng.choice([-0.01, 0.01])),
        sigma_px=SHIPPED.sigma_px,
    )


CALIBRATION_GATE = 24.3  # chi-square, 7 degrees of freedom, 99.9 %


def slow(seed):
    return pytest.param(seed, marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *map(slow, range(1, 6))])
def test_extrinsic_and_time_offset_are_estimated(seed):
    """The filter says how well it knows them, 2 to 5 mm after 30 s, and is as far off as it says: an error
    of 5 or 6 mm in one of six runs is no fault."""
    found = run(seed, wrong(seed, 1.0))
    left = found.extrinsics[-1] * [1, 1, 1, 1, 1, 1, -1]  # truth less estimate, as the covariance has it
    cov = found.state.cov[EXTRINSIC.start : CORE_SIZE, EXTRINSIC.start : CORE_SIZE]
    turn, shift, offset = (np.sqrt(np.trace(cov[a:b, a:b])) for a, b in ((0, 3), (3, 6), (6, 7)))
    print(np.degrees(turn), 1e3 * shift, 1e3 * offset, left @ np.linalg.solve(cov, left))
    assert np.degrees(turn) < 0.2
    assert shift < 0.005
    assert offset < 0.0005
    assert left @ np.linalg.solve(cov, left) < CALIBRATION_GATE


@pytest.mark.slow
def test_a_wrong_extrinsic_shows_in_the_nees():
    assert nees(3, wrong(0, 0.0)).min() > 20


def test_the_same_seed_gives_the_same_bits():
    a, b = (run(3, Setup(seconds=1.0)) for _ in range(2))
    assert a.state.cov.tobytes() == b.state.cov.tobytes()
    assert a.pose_errors.tobytes() == b.pose_errors.tobytes()
