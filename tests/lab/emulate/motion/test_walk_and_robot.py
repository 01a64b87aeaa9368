import numpy as np
import pytest
from helpers.motion_sim import driver, every, floor, person, track

from share.lab.emulate.motion import walk
from share.lab.emulate.motion.crowd import path_length
from share.lab.emulate.motion.track import KNOT_S
from share.lab.emulate.motion.walk import step_phase


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("speed", [0.6, 1.4])
def test_a_walk_has_human_speeds_and_accelerations(seed, speed):
    path = person(seed, speed)
    stamps = every(path, 200)
    T, (rate, force) = path.poses(stamps), path.inertial(stamps)
    z, quick = T[:, 2, 3], np.linalg.norm(rate, axis=1)
    assert 1.60 < z.min() < z.max() < 1.80
    assert 1.0 < quick.max() < 3.2
    assert (T[:, 2, 1] < -0.75).all()  # image down is world down: the head stays upright
    assert np.linalg.norm(force, axis=1).max() < 25
    assert floor().clearance_at(T[:, :2, 3]).min() > 0.1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("motion", [person, driver])
def test_all_stand_still_for_a_second(seed, motion):
    path = motion(seed)
    first = every(path, 200, 1.0)
    T, (rate, force) = path.poses(first), path.inertial(first)
    assert np.linalg.norm(np.ptp(T[:, :3, 3], axis=0)) < 0.02
    assert np.linalg.norm(rate, axis=1).max() < 0.05
    assert np.abs(np.linalg.norm(force, axis=1) - 9.81).max() < 0.15
    assert path_length(path) > 2  # and then they go


def test_steps_follow_the_walk_ratio():
    phase, vigour = step_phase(np.full(2001, 1.4))
    hz = phase[-1] / (2 * np.pi * 2000 * KNOT_S)
    assert hz == pytest.approx(1.89, abs=0.02) and vigour.min() == 1
    assert step_phase(np.zeros(10))[0].max() == 0


def test_the_head_bobs_at_the_step_rate():
    path = person(0, 1.4)
    z = path.poses(every(path, 100))[1000:2000, 2, 3]
    spectrum = np.abs(np.fft.rfft(z - z.mean()))
    hz = np.fft.rfftfreq(len(z), 0.01)
    assert 1.3 < hz[np.argmax(spectrum * (hz > 0.5))] < 2.3


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_does_not_slip(seed):
    path = driver(seed, vibration=0.0)
    stamps = every(path, 200)
    v, T = path.velocity(stamps), path.poses(stamps)
    ahead = T[:, :2, 2] / np.linalg.norm(T[:, :2, 2], axis=1, keepdims=True)
    assert np.abs(ahead[:, 0] * v[:, 1] - ahead[:, 1] * v[:, 0]).max() < 1e-4
    assert np.sum(ahead * v[:, :2], axis=1).min() > -1e-3
    assert np.ptp(T[:, 2, 3]) < 1e-9


def test_a_robot_turns_in_place_somewhere():
    path = driver(1, vibration=0.0)
    stamps = every(path, 50)
    turning = np.abs(path.inertial(stamps)[0][:, 1])
    slow = np.linalg.norm(path.velocity(stamps), axis=1) < 0.03
    assert (turning[slow] > 0.3).mean() > 0.05


def test_vibration_is_as_strong_as_asked_and_gone_at_rest():
    calm, rough = (driver(1, vibration=v) for v in (0.0, 0.8))
    stamps = every(calm, 400)
    up = rough.inertial(stamps)[1] - calm.inertial(stamps)[1]
    speed = np.linalg.norm(calm.velocity(stamps), axis=1)
    moving = np.abs(speed - 0.3) < 0.05
    assert up[moving][:, 1].std() == pytest.approx(0.8, rel=0.25)
    assert up[:400, 1].std() < 0.05


def test_the_motion_depends_on_the_seed_alone():
    stamps = every(person(), 30)
    person.cache_clear(), track.cache_clear()
    again = person()
    assert np.array_equal(again.poses(stamps), person().poses(stamps))
    assert not np.allclose(again.poses(stamps), person(2).poses(stamps))


def test_the_head_turns_to_other_agents():
    from share.lab.emulate.motion.walk import GazeAgent
    from share.lab.emulate.types import START_NS

    own = track("person", 1)
    other = GazeAgent(
        own.xy + 2.0 * np.stack([np.cos(own.heading + 0.6), np.sin(own.heading + 0.6)], axis=1), 1.6
    )
    path = walk.headset_path(own, 1.7, 2.6, np.zeros((0, 3)), [other], START_NS, np.random.default_rng(1))
    T = path.poses(START_NS + np.round(own.seconds * 1e9).astype(np.int64)[:-1])
    to = np.column_stack([other.xy[:-1], np.full(len(T), 1.6)]) - T[:, :3, 3]
    met = np.einsum("ni,ni->n", T[:, :3, 2], to / np.linalg.norm(to, axis=1, keepdims=True)) > 0.97
    assert 0.1 < met.mean() < 0.9
