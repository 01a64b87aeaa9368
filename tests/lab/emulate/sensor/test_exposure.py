import numpy as np
import pytest

from share.lab.emulate.sensor.imager import auto_exposure, blur_offsets, lamp_light
from share.sensors.profile_types import ExposureModel

MODEL = ExposureModel(target=100, delay_frames=2, damping=0.5, step=0.03, longest_ms=16)


def expose(brightness):
    time, gain = auto_exposure(np.asarray(brightness, float), MODEL, 8.0, (0.01, 33.0), (1.0, 16.0))
    return time, gain, time * gain / 8.0 * brightness  # what the pictures' mean becomes


def test_a_steady_scene_is_at_the_target_from_the_first_picture():
    time, gain, mean = expose(np.full(50, 70.0))
    assert np.abs(mean / 100 - 1).max() < 0.02
    assert (time == time[0]).all() and (gain == 1).all()


def test_a_switched_lamp_is_followed_late_in_steps_and_without_overshoot():
    time, _, mean = expose(np.r_[np.full(20, 50.0), np.full(60, 200.0)])
    assert mean[20] > 350  # still the old exposure: glaring
    assert (time[20:23] == time[20]).all()  # the frames of the delay
    assert time[23] < time[20]
    assert (np.diff(time[20:]) <= 0).all()
    assert np.abs(mean[45:] / 100 - 1).max() < 0.07
    steps = np.log(time[23:]) / np.log(1.03)
    assert np.abs(steps - np.rint(steps)).max() < 1e-6


def test_darkness_lengthens_the_exposure_to_its_limit_then_raises_the_gain_to_its_own():
    time, gain, mean = expose(np.full(10, 10.0))
    assert time[0] == 16 and 4.9 < gain[0] < 5.1 and abs(mean[0] - 100) < 3
    time, gain, mean = expose(np.zeros(5))
    assert time[0] == 16 and gain[0] == pytest.approx(16) and mean[0] == 0
    time, gain, _ = expose(np.full(5, 1e7))
    assert time[0] == pytest.approx(0.01) and gain[0] == 1


def test_an_empty_series_has_no_exposures():
    assert [len(x) for x in expose(np.zeros(0))] == [0, 0, 0]


def test_lamps_switch_at_their_mean_interval_in_any_span():
    since = np.arange(0, 600 * 10**9, 10**8)
    light = lamp_light((4,), since, 5.0, 1.5)
    switchings = (np.diff(light) != 0).sum()
    assert 90 < switchings < 150
    assert 2**-1.5 <= light.min() < 0.6 and 1.6 < light.max() <= 2**1.5
    assert light[0] == 1
    part = since[300:400]
    assert np.array_equal(lamp_light((4,), part, 5.0, 1.5), light[300:400])
    assert (lamp_light((4,), since, 0.0, 1.5) == 1).all()


def test_blur_is_sampled_finely_enough_about_the_stamp():
    assert np.array_equal(blur_offsets(10.0, 0.2), [0.0])
    for motion, count in ((0.5, 3), (4.5, 5), (100.0, 16)):
        s = blur_offsets(10.0, motion)
        assert len(s) == count
        assert abs(s.mean()) < 1e-15 and np.abs(s).max() < 0.005
        assert np.allclose(np.diff(s), 0.010 / count)
