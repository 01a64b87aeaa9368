import time
from dataclasses import replace

import numpy as np

from share.lab.emulate.sensor.imager import Exposure, Imager, vignetting_gain
from share.sensors.profile import load_profile

PROFILE = load_profile("d435i")
CAMERA = PROFILE.mode.cameras()[0]
MODEL = PROFILE.emulation.camera
EVEN = replace(MODEL, pixel_gain=0.0, pixel_offset_e=0.0)
REFERENCE = Exposure(MODEL.reference_ms)


def imager(model=MODEL, seed=(1, 0), noise=True, vignetting=False, blur=False):
    return Imager(CAMERA, model, seed, noise, vignetting, blur)


def flat(level):
    return np.full((480, 640), level, np.float32)


def test_a_perfect_imager_rounds_and_saturates():
    perfect = imager(noise=False)
    ramp = np.linspace(0, 300, 480 * 640, dtype=np.float32).reshape(480, 640)
    assert np.array_equal(
        perfect.develop(ramp, 0, REFERENCE), np.rint(np.minimum(ramp, 255)).astype(np.uint8)
    )
    half = replace(REFERENCE, exposure_ms=MODEL.reference_ms / 4, gain=2.0)
    assert np.array_equal(perfect.develop(flat(100), 0, half), np.full((480, 640), 50, np.uint8))
    assert np.array_equal(
        perfect.develop(flat(100), 0, replace(half, light=3.0)), np.full((480, 640), 150, np.uint8)
    )


def test_variance_is_affine_in_the_signal_and_grows_with_the_gain():
    """EMVA 1288: var = K gray + (K read)^2, plus 1/12 for rounding."""
    camera = imager(EVEN)
    for gain in (1.0, 4.0):
        K = 255 * gain / EVEN.full_well_e
        for level in (20.0, 60.0, 120.0, 200.0):
            noisy = camera.develop(flat(level / gain), 3, replace(REFERENCE, gain=gain)).astype(float)
            expected = K * level + (K * EVEN.read_e) ** 2 + 1 / 12
            assert abs(noisy.var() / expected - 1) < 0.02
            assert abs(noisy.mean() - level) < 0.05


def test_noise_belongs_to_device_camera_and_frame():
    camera = imager()
    picture = camera.develop(flat(100), 7, REFERENCE)
    camera.develop(flat(30), 8, REFERENCE)
    assert np.array_equal(picture, camera.develop(flat(100), 7, REFERENCE))
    assert np.array_equal(picture, imager().develop(flat(100), 7, REFERENCE))
    for other in (
        camera.develop(flat(100), 8, REFERENCE),
        imager(seed=(1, 1)).develop(flat(100), 7, REFERENCE),
    ):
        assert (picture != other).mean() > 0.4


def test_the_bank_leaves_no_trace_in_space_or_time():
    """White within a picture (neighbours), and over 40 frames no two share noise at the same pixel."""
    camera = imager(EVEN)
    stack = np.stack([camera.develop(flat(100), k, REFERENCE)[::2, ::2] - 100.0 for k in range(40)])
    one = camera.develop(flat(100), 0, REFERENCE) - 100.0
    for shifted in (one[:, 1:] * one[:, :-1], one[1:] * one[:-1]):
        assert abs(shifted.mean() / one.var()) < 0.01
    C = np.corrcoef(stack.reshape(40, -1))
    assert np.abs(C - np.eye(40)).max() < 0.02
    assert abs(stack.mean(axis=0).std() / (one.std() / np.sqrt(40)) - 1) < 0.02  # averages out as white noise


def test_fixed_pattern_stays_while_noise_averages_out():
    camera = imager()
    mean = np.mean([camera.develop(flat(100), k, REFERENCE) for k in range(60)], axis=0)
    K = 255 / MODEL.full_well_e
    pattern = np.hypot(100 * MODEL.pixel_gain, K * MODEL.pixel_offset_e)
    left = np.sqrt((K * 100 + (K * MODEL.read_e) ** 2 + 1 / 12) / 60)
    assert abs(mean.std() / np.hypot(pattern, left) - 1) < 0.05


def test_vignetting_is_one_in_the_middle_and_as_stated_in_the_corner():
    light = vignetting_gain(CAMERA, 0.6)
    assert abs(light.max() - 1) < 1e-4
    corners = light[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert abs(corners.min() - 0.6) < 1e-6 and corners.max() < 0.61
    assert (np.diff(light[240, 330:]) < 0).all()
    assert (vignetting_gain(CAMERA, 1.0) == 1).all()


def test_the_lens_blurs_by_its_psf_and_keeps_the_light():
    point = np.zeros((480, 640), np.float32)
    point[240, 320] = 1e4
    soft = imager(replace(EVEN, psf_px=0.7), noise=False, blur=True).develop(
        point, 0, replace(REFERENCE, gain=0.01)
    )
    soft = soft.astype(float)
    x = np.arange(640) - 320
    assert abs(soft.sum() - 100) < 6  # rounding to whole gray levels
    assert abs((soft.sum(axis=0) * x**2).sum() / soft.sum() - 0.49) < 0.1


def test_a_picture_takes_two_milliseconds_at_most():
    camera, picture = imager(vignetting=True, blur=True), flat(100)
    camera.develop(picture, 0, REFERENCE)
    spent = []
    for k in range(15):
        start = time.process_time()
        camera.develop(picture, k, REFERENCE)
        spent.append(time.process_time() - start)
    assert np.median(spent) < 0.004  # measured 0.9 ms; twice the budget where others compute
