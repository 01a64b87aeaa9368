import numpy as np

from share.emulate.plain.sensor import Sensor


def test_gray_noise_is_two_levels_and_belongs_to_the_frame():
    flat = np.full((480, 640), 100, np.uint8)
    sensor = Sensor((0, 3))
    noisy = sensor.gray(flat, 7, 0)
    assert abs(noisy.astype(float).std() - 2.0) < 0.2
    assert abs(noisy.mean() - 100) < 0.1
    assert np.array_equal(noisy, Sensor((0, 3)).gray(flat, 7, 0))
    for other in (sensor.gray(flat, 8, 0), sensor.gray(flat, 7, 1), Sensor((1, 3)).gray(flat, 7, 0)):
        assert (noisy != other).mean() > 0.5


def test_depth_noise_grows_with_the_square_of_depth():
    """sigma_z = z^2 sigma_d / (f b), sigma_d = 0.1 px; rounding to 1/32 px adds a hundredth of a pixel."""
    for z in (1.0, 3.0, 5.0):
        raw = np.concatenate([
            Sensor((0, 3)).depth_mm(np.full((480, 640), z, np.float32), 19.25, k).ravel() for k in range(4)
        ])  # fmt: skip
        read = raw[raw > 0] / 1000
        assert raw.dtype == np.uint16
        assert 0.003 < (raw == 0).mean() < 0.05
        assert abs(np.median(read) - z) < 0.05 * z
        assert abs(read.std() / (z**2 * 0.1 / 19.25) - 1) < 0.15


def test_the_edge_of_a_near_thing_hides_what_is_behind_and_a_slope_does_not():
    step = np.full((480, 640), 4.0, np.float32)
    step[:, 320:] = 2.0
    raw = Sensor((0, 3)).depth_mm(step, 19.25, 0)
    assert (raw[:, 319:321] == 0).all()
    row = np.arange(480, dtype=np.float32)[:, None]
    floor = np.broadcast_to(0.35 * 385 / (row / 2 + 40), (480, 640)).astype(np.float32)  # from 0.35 m above
    assert (Sensor((0, 3)).depth_mm(floor, 19.25, 0) == 0).mean() < 0.05


def test_far_and_near_are_not_measured():
    for z in (0.2, 20.0):
        assert (Sensor((0, 3)).depth_mm(np.full((480, 640), z, np.float32), 19.25, 0) == 0).all()
