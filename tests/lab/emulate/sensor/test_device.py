"""The whole device: closed-form motion integrated back, stamps, exposure, and independence of call order."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from share.geometry import se3
from share.lab.emulate.sensor.device import EmulatedDevice
from share.lab.emulate.sensor.effects import NO_EFFECTS, Effects, parse_effects
from share.lab.emulate.types import GRAVITY
from share.sensors.profile import load_profile
from share.sensors.stamps import WRAP_NS
from share.types import ImuBatch

START = 1_750_000_000 * 10**9
S = 10**9


@dataclass(frozen=True)
class Loop:
    """A walk round a circle of 1.2 m at 0.9 m/s, bobbing, with head turns up to 3 rad/s: all in closed form.

    R = Rz(yaw) Ry(pitch) Rx(roll), each angle a sum of sines."""

    start_ns: int = START
    end_ns: int = START + 12 * S
    recorded: ImuBatch | None = None
    gaps: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    def _angles(self, t):
        """(angle, rate) of yaw, pitch, roll."""
        waves = ([(1.5, 1.9, 0.0), (0.15, 6.1, 0.3)], [(0.4, 1.3, 0.5), (0.03, 11.9, 0.0)], [(0.2, 0.9, 1.0)])
        for terms in waves:
            yield (
                sum(a * np.sin(w * t + p) for a, w, p in terms),
                sum(a * w * np.cos(w * t + p) for a, w, p in terms),
            )

    def poses(self, stamps_ns):
        t = (stamps_ns - START) / 1e9
        (yaw, _), (pitch, _), (roll, _) = self._angles(t)
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
        T[:, :3, 3] = self._position(t, 0)
        return T

    def velocity(self, stamps_ns):
        return self._position((stamps_ns - START) / 1e9, 1)

    def inertial(self, stamps_ns):
        t = (stamps_ns - START) / 1e9
        (_, dyaw), (pitch, dpitch), (roll, droll) = self._angles(t)
        sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
        rate = np.stack(
            [droll - dyaw * sp, dpitch * cr + dyaw * cp * sr, -dpitch * sr + dyaw * cp * cr], axis=1
        )
        force = self._position(t, 2) + np.array([0, 0, GRAVITY])
        R = self.poses(stamps_ns)[:, :3, :3]
        return rate, np.einsum("nji,nj->ni", R, force)

    def _position(self, t, order):
        def sine(a, w, phase):
            return a * w**order * np.sin(w * t + phase + order * np.pi / 2)

        height = sine(0.03, 11.0, 0.2) + (1.6 if order == 0 else 0.0)
        return np.stack([sine(1.2, 0.75, np.pi / 2), sine(1.2, 0.75, 0.0), height], axis=1)


def _turn(axis, angle):
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i], R[:, i, j] = np.sin(angle), -np.sin(angle)
    return R


def integrate(batch: ImuBatch, path: Loop):
    """Strapdown from the true state at the first sample, by Runge-Kutta over splines through the samples;
    position error m, rotation error deg at the last."""
    t = (batch.stamps_ns - batch.stamps_ns[0]) / 1e9
    spline = CubicSpline(t, np.concatenate([batch.gyro, batch.accel], axis=1))
    dt, middle = np.diff(t), spline(t[:-1] + np.diff(t) / 2)
    known = spline(t)

    def slope(state, reading):
        R, v = state[:, :3], state[:, 3]
        force = R @ reading[3:] - (0, 0, GRAVITY)
        return np.column_stack([R @ se3.hat(reading[:3]), force, v])

    state = np.column_stack(
        [path.poses(batch.stamps_ns[:1])[0, :3, :3], path.velocity(batch.stamps_ns[:1])[0]]
    )
    state = np.column_stack([state, path.poses(batch.stamps_ns[:1])[0, :3, 3]])
    for k, h in enumerate(dt):
        k1 = slope(state, known[k])
        k2 = slope(state + h / 2 * k1, middle[k])
        k3 = slope(state + h / 2 * k2, middle[k])
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(state + h * k3, known[k + 1]))
    T = path.poses(batch.stamps_ns[-1:])[0]
    return np.linalg.norm(state[:, 4] - T[:3, 3]), np.rad2deg(se3.rotation_angle(T[:3, :3].T @ state[:, :3]))


@pytest.mark.parametrize(
    ("name", "rates"), [("d435i", (None, None)), ("d435i", (200, 200)), ("euroc", (None, None))]
)
def test_a_perfect_imu_integrated_from_the_true_start_ends_at_the_true_pose(name, rates):
    path = Loop()
    device = EmulatedDevice(load_profile(name, None, *rates), NO_EFFECTS, (3,), START)
    batch = device.imu_streams(path).to_batch()
    ten = batch.stamps_ns <= batch.stamps_ns[0] + 10 * S
    metres, degrees = integrate(batch.take(ten), path)
    assert metres < 0.001 and degrees < 0.01


def test_a_noisy_imu_integrated_from_the_true_start_drifts():
    path = Loop()
    batch = EmulatedDevice(load_profile("d435i"), Effects(), (3,), START).imu_streams(path).to_batch()
    metres, degrees = integrate(batch, path)
    assert metres > 0.1 and degrees > 0.05


def test_gyro_and_accel_are_streams_of_their_own_unless_the_device_joins_them():
    streams = EmulatedDevice(load_profile("d435i"), NO_EFFECTS, (3,), START).imu_streams(Loop())
    assert np.unique(np.diff(streams.gyro_ns)).tolist() == [2_500_000]
    assert np.unique(np.diff(streams.accel_ns)).tolist() == [4_000_000]
    assert (streams.gyro_ns % 1000 == 0).all()
    assert len(np.intersect1d(streams.gyro_ns, streams.accel_ns)) == 0
    joined = EmulatedDevice(load_profile("euroc"), NO_EFFECTS, (3,), START).imu_streams(Loop())
    assert np.array_equal(joined.gyro_ns, joined.accel_ns)
    pictures = EmulatedDevice(load_profile("euroc"), NO_EFFECTS, (3,), START).picture_times(START, START + S)
    assert np.isin(pictures.stamp_ns, joined.gyro_ns).all()


def test_a_recorded_imu_is_left_untouched(rng):
    stamps = START + np.arange(100) * 5_000_000
    recorded = ImuBatch(stamps, rng.normal(size=(100, 3)), rng.normal(size=(100, 3)))
    batch = (
        EmulatedDevice(load_profile("euroc"), Effects(), (3,), START)
        .imu_streams(Loop(recorded=recorded))
        .to_batch()
    )
    assert np.array_equal(batch.stamps_ns, stamps)
    assert np.array_equal(batch.gyro, recorded.gyro) and np.array_equal(batch.accel, recorded.accel)


def test_time_offset_is_kalibrs_t_imu_is_t_cam_plus_shift():
    for shift in (8.0, -15.0):
        pictures = EmulatedDevice(
            load_profile("euroc"), parse_effects([f"time_offset_ms={shift}"]), (3,), START
        ).picture_times(START, START + S)
        assert np.array_equal(pictures.true_ns, pictures.stamp_ns + round(shift * 1e6))


@pytest.mark.parametrize("name", ["euroc", "d435i"])
def test_pictures_are_taken_and_stamped_later_than_the_clock_says_by_their_phase(name):
    """So that no IMU sample is of the moment of a picture."""
    whole, later = (
        EmulatedDevice(load_profile(name), parse_effects(["none", *more]), (3,), START).picture_times(
            START, START + S
        )
        for more in ([], ["camera_phase_ms=1.7"])
    )
    common = len(later) - 1
    assert np.array_equal(later.true_ns[:common], whole.true_ns[:common] + 1_700_000)
    assert np.array_equal(later.stamp_ns[:common], whole.stamp_ns[:common] + 1_700_000)


def test_frames_keep_number_time_and_stamp_whatever_span_is_asked_for():
    effects = parse_effects(
        ["drops=0.2", "drop_burst=2", "jitter_ms=1", "clock_drift_ppm=15", "clock_offset_ms=-3"]
    )
    device = EmulatedDevice(load_profile("d435i"), effects, (4,), START)
    whole = device.picture_times(START, START + 60 * S)
    part = EmulatedDevice(load_profile("d435i"), effects, (4,), START).picture_times(
        START + 20 * S, START + 30 * S
    )
    here = np.isin(whole.index, part.index)
    for name in ("index", "true_ns", "stamp_ns"):
        assert np.array_equal(getattr(whole, name)[here], getattr(part, name))
    assert 0.7 < len(whole) / 1800 < 0.9
    assert (np.diff(whole.stamp_ns) > 0).all()
    drift = whole.stamp_ns - whole.true_ns + 3_000_000
    assert abs(np.polyfit((whole.true_ns - START) / 1e9, drift, 1)[0] / 15_000 - 1) < 0.3


def test_two_devices_do_not_sample_at_the_same_moments():
    a, b = (
        EmulatedDevice(load_profile("d435i"), NO_EFFECTS, (seed,), START).picture_times(START, START + S)
        for seed in (1, 2)
    )
    assert abs(int(a.true_ns[0] - b.true_ns[0])) > 100_000


def test_stamps_wrap_as_the_d4xx_does_and_truth_knows_when_they_were():
    effects = parse_effects(["none", "wrap=on", "clock_offset_ms=1.5"])
    origin = START // WRAP_NS * WRAP_NS - 5 * S  # wraps after 5 s
    device = EmulatedDevice(load_profile("d435i"), effects, (4,), origin)
    pictures = device.picture_times(origin, origin + 10 * S)
    assert pictures.stamp_ns.max() < WRAP_NS and (np.diff(pictures.stamp_ns) < 0).sum() == 1
    true_ns, repaired = device.truth_times(pictures)
    assert (np.diff(repaired) > 0).all()
    assert np.abs(true_ns - pictures.true_ns).max() < 1000
    batch = device.imu_streams(Loop(start_ns=origin, end_ns=origin + 10 * S)).to_batch()
    assert (np.diff(batch.stamps_ns) < 0).sum() == 1 and len(batch) > 3980


def test_exposure_follows_the_light_and_off_leaves_it_alone():
    times = START + np.arange(300) * 33_333_333
    seen = np.full(300, 60.0)
    device = EmulatedDevice(load_profile("d435i"), parse_effects(["lamp_every_s=2"]), (4,), START, (9,))
    shots = device.exposures(times, seen)
    assert len(np.unique(shots.light)) > 3 and len(np.unique(shots.exposure_ms * shots.gain)) > 10
    other = EmulatedDevice(load_profile("d435i"), parse_effects(["lamp_every_s=2"]), (5,), START, (9,))
    assert np.array_equal(
        other.exposures(times, seen).light, shots.light
    )  # the room's lamps, not the device's
    fixed = EmulatedDevice(load_profile("d435i"), parse_effects(["exposure=off"]), (4,), START).exposures(
        times, seen
    )
    assert (fixed.exposure_ms == 8.0).all() and (fixed.gain == 1).all() and (fixed.light == 1).all()


def test_pictures_come_out_at_the_target_brightness():
    device = EmulatedDevice(load_profile("d435i"), Effects(), (4,), START)
    for radiance in (15.0, 60.0, 240.0):
        shot = device.exposures(np.array([START]), np.array([radiance]))[0]
        picture = device.develop_image(np.full((480, 640), radiance, np.float32), 0, 0, shot)
        assert abs(picture.mean() - 100) < 3


def test_an_exposure_ends_before_the_next_picture():
    dark = EmulatedDevice(load_profile("d435i", "640x480@90"), Effects(), (4,), START).exposures(
        np.array([START]), np.array([5.0])
    )
    assert dark.exposure_ms[0] == pytest.approx(10.0) and dark.gain[0] > 10


def test_blur_off_draws_one_sharp_picture():
    sharp = EmulatedDevice(load_profile("d435i"), parse_effects(["blur=off"]), (4,), START)
    blurred = EmulatedDevice(load_profile("d435i"), Effects(), (4,), START)
    shot = blurred.exposures(np.array([START]), np.array([60.0]))[0]
    assert len(sharp.blur_offsets(shot, 20.0)) == 1 and len(blurred.blur_offsets(shot, 20.0)) == 16


def test_cameras_of_one_device_and_devices_differ_in_their_noise():
    even = np.full((480, 640), 100, np.float32)
    a, b = (EmulatedDevice(load_profile("d435i"), Effects(), (seed,), START) for seed in (1, 2))
    left = a.develop_image(even, 5, 0)
    assert np.array_equal(
        left, EmulatedDevice(load_profile("d435i"), Effects(), (1,), START).develop_image(even, 5, 0)
    )
    assert (left != a.develop_image(even, 5, 1)).mean() > 0.4
    assert (left != b.develop_image(even, 5, 0)).mean() > 0.4
