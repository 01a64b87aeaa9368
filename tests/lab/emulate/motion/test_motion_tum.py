import numpy as np
import pytest
from helpers.motion_sim import every, person

from share.errors import DataError
from share.geometry import se3
from share.lab.emulate.motion.spline import fit_spline, read_tum_path
from share.recordings.trajectory import Trajectory, format_tum


def write(tmp_path, stamps, T):
    file = tmp_path / "path.tum"
    file.write_text(format_tum(Trajectory(stamps, T)))
    return file


@pytest.fixture
def samples():
    stamps = every(person(), 100, 12.0)
    return stamps, person().poses(stamps)


def test_clean_poses_come_back(tmp_path, samples):
    path = read_tum_path(write(tmp_path, *samples))
    T = path.poses(samples[0])
    assert np.linalg.norm(T[:, :3, 3] - samples[1][:, :3, 3], axis=1).max() < 2e-4
    assert np.degrees(se3.rotation_angle(se3.inverse(T) @ samples[1])).max() < 0.02


def test_noise_is_smoothed_away(samples, rng):
    stamps, T = samples
    noisy = T @ se3.exp(rng.normal(0, [0.003] * 3 + [0.003] * 3, (len(T), 6)))
    off = fit_spline(stamps, noisy).poses(stamps)[:, :3, 3] - T[:, :3, 3]
    assert np.sqrt((off**2).sum(1).mean()) < 0.6 * 0.003 * np.sqrt(3)
    clean, found = person().inertial(stamps)[1], fit_spline(stamps, noisy).inertial(stamps)[1]
    assert np.sqrt(((clean - found) ** 2).sum(1).mean()) < 3.0  # two differences would make 70 m/s^2


def test_gaps_stay_gaps_and_are_crossed_smoothly(samples):
    stamps, T = samples
    keep = (stamps < stamps[500]) | (stamps > stamps[600])
    path = fit_spline(stamps[keep], T[keep])
    assert path.gaps.tolist() == [[stamps[499], stamps[601]]]
    inside = stamps[500:601]
    assert np.linalg.norm(path.poses(inside)[:, :3, 3] - T[500:601, :3, 3], axis=1).max() < 0.3
    assert np.linalg.norm(path.inertial(inside)[1], axis=1).max() < 20


def test_a_part_is_taken(tmp_path, samples):
    path = read_tum_path(write(tmp_path, *samples), start=2.0, seconds=5.0)
    assert path.start_ns == samples[0][200] and path.end_ns == samples[0][700]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda s, T: (s[::-1], T), "line 2"),
        (lambda s, T: (s[:10], T[:10]), "too few"),
        (lambda s, T: (s[::30], T[::30]), "says nothing of accelerations"),
        (lambda s, T: (np.r_[s[:500], s[500:] + 6 * 10**9], T), "no pose for 6.0 s"),
        (lambda s, T: (s, np.tile(T[:1], (len(T), 1, 1))), "does not move"),
    ],
)
def test_invalid_motion_is_refused_in_one_line(tmp_path, samples, spoil, says):
    with pytest.raises(DataError) as caught:
        read_tum_path(write(tmp_path, *spoil(*samples)))
    assert says in str(caught.value) and "path.tum" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("bad", ["1.0 nan 0 0 0 0 0 1", "1.0 0 0 0 0 0 0 0"])
def test_invalid_poses_are_refused(tmp_path, bad):
    file = tmp_path / "bad.tum"
    file.write_text("0.5 0 0 0 0 0 0 1\n" + bad + "\n")
    with pytest.raises(DataError, match=r"bad\.tum"):
        read_tum_path(file)
    file.write_text("0.5 0 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match="nothing is left"):
        read_tum_path(file, start=5)
