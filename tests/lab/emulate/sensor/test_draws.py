import numpy as np

from share.lab.emulate.sensor.clock import normal, uniform


def test_a_number_belongs_to_its_index():
    whole = uniform((7,), np.arange(10_000))
    some = np.array([9_999, 3, 5_000, 3])
    assert np.array_equal(uniform((7,), some), whole[some])
    assert np.array_equal(normal((7,), some), normal((7,), np.arange(10_000))[some])


def test_they_are_uniform_normal_and_of_their_seed():
    u, n = uniform((1, 2), np.arange(100_000)), normal((1, 2), np.arange(100_000))
    assert u.min() >= 0 and u.max() < 1 and abs(u.mean() - 0.5) < 0.005
    assert abs(n.mean()) < 0.01 and abs(n.std() - 1) < 0.01
    assert abs(np.corrcoef(n[:-1], n[1:])[0, 1]) < 0.01
    assert not np.isin(uniform((1, 3), np.arange(1000)), u[:1000]).any()
