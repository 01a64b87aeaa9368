"""Keyframe sets agree with a recording of the same recipe, and are cached."""

from __future__ import annotations

import importlib
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from helpers.frame_keyframe import frame_image
from helpers.small_session import small_profile, small_recipe

from share.config import Config
from share.errors import DataError, UsageError
from share.geometry import se3
from share.lab.emulate.session import make_session
from share.mapping.recognition.patch_alignment import ImageView
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters
from share.types import AgentKind
from share.vision.keyframe_images import decompress

pytestmark = pytest.mark.long

TOOLS = Path(__file__).resolve().parents[2] / "tools" / "experiments"
NAMES = {"ann": AgentKind.AR, "rob": AgentKind.ROBOT}


@pytest.fixture(scope="module")
def tool():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOLS)
        yield importlib.import_module


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    profile = small_profile(tmp_path_factory.mktemp("profile"))
    return small_recipe(profile, "ann=walk:", "rob=robot:", seconds=4.0, seed=3)


@pytest.fixture(scope="module")
def every(tool):
    return tool("keyframe_set").Spacing(0.1, 0.15, 0.25)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def made(tool, recipe, every, cache):
    return tool("keyframe_set").keyframe_set(recipe, every, cache)


@pytest.mark.slow
def test_images_and_truth_equal_those_of_the_recording(made, recipe, tmp_path):
    session = make_session(recipe, tmp_path / "session", workers=1)
    for name, kind in NAMES.items():
        source, agent = open_source(str(session / name)), made.agents[name]
        truth, frames = source.truth(), read_frames(source, Config(), SequencerCounters())
        recorded = {frame.stamp_ns: frame for frame in frames}
        assert (agent.hello.name, agent.hello.kind) == (name, kind)
        assert agent.hello.rig.cam0.focal == source.rig.cam0.focal
        assert np.allclose(agent.hello.rig.T_body_cam0, source.rig.T_body_cam0, atol=1e-9)
        assert len(agent.keyframes) == len(agent.T_world_body) == len(agent.T_odom_body) >= 3
        for keyframe, T in zip(agent.keyframes, agent.T_world_body, strict=True):
            image = frame_image(recorded[keyframe.stamp_ns], source.rig, 70)
            assert np.array_equal(keyframe.image.jpeg, image.jpeg)
            assert np.allclose(keyframe.image.points, image.points, atol=1e-5)
            assert np.allclose(truth.T[truth.stamps_ns == keyframe.stamp_ns], T, atol=1e-8)
        rig = agent.hello.rig
        views = [ImageView(k.image, rig.cam0, rig.T_body_cam0).describe() for k in agent.keyframes]
        known = [np.isfinite(view.points).all(axis=1).sum() for view in views]
        assert np.median(known) > 20


def test_keyframes_follow_the_spacing(made, every):
    for agent in made.agents.values():
        stamps = np.array([k.stamp_ns for k in agent.keyframes])
        T = se3.inverse(agent.T_world_body[:-1]) @ agent.T_world_body[1:]
        far = (np.linalg.norm(T[:, :3, 3], axis=1) >= every.metres) | (se3.rotation_angle(T) >= every.radians)
        assert far.all() and (np.diff(stamps) >= every.seconds * 1e9).all()


def test_another_agent_on_the_same_track_sends_other_images(tool, made):
    """Features of the same place: as large, and nearly the same depths."""
    one, other = (list(islice(tool("load_tracks").Walker(made, k).keyframes(), 5)) for k in (0, 2))
    camera = made.agents["ann"].hello.rig.cam0
    sent = {k.stamp_ns: k for k in made.agents["ann"].keyframes}
    assert all(decompress(k.image, camera) is not None for k in (*one, *other, *sent.values()))
    sizes = [len(k.image.jpeg) for k in (*one, *sent.values())]
    assert max(sizes) < 1.5 * min(sizes)
    assert {k.image.jpeg.tobytes() for k in one}.isdisjoint(k.image.jpeg.tobytes() for k in other)
    assert len(one[0].view) == 0 and len(one[0].image.uv) > 20


def test_keyframe_steps_add_up_to_odometry(made):
    for agent in made.agents.values():
        T = np.eye(4)
        for k, keyframe in enumerate(agent.keyframes):
            assert (keyframe.id, keyframe.reference) == (k, k - 1)
            T = T @ keyframe.T_ref_body
            assert np.allclose(T, agent.T_odom_body[k], atol=1e-9)
            tilt = np.degrees(np.arccos(keyframe.up @ agent.T_world_body[k, 2, :3]))
            assert np.allclose(keyframe.up, T[2, :3], atol=1e-9) and tilt < 0.6


def test_cached_set_is_not_made_again(tool, made, recipe, every, cache, monkeypatch):
    def never(*_):
        raise AssertionError("made again")

    monkeypatch.setattr(tool("keyframe_making"), "make", never)
    again = tool("keyframe_set").keyframe_set(recipe, every, cache)
    assert again.size == made.size and again.agents.keys() == made.agents.keys()
    for name, agent in again.agents.items():
        assert agent.hello.run_id == made.agents[name].hello.run_id
        assert np.array_equal(agent.T_world_body, made.agents[name].T_world_body)
        assert np.array_equal(agent.keyframes[-1].points, made.agents[name].keyframes[-1].points)
        assert np.array_equal(agent.keyframes[-1].image.jpeg, made.agents[name].keyframes[-1].image.jpeg)
    with pytest.raises(AssertionError, match="made again"):
        tool("keyframe_set").keyframe_set(recipe, type(every)(0.3, 0.3), cache)


def test_damaged_file_is_named(tool, made, recipe, every, cache, tmp_path):
    data = tool("keyframe_set").place(recipe, every, cache).read_bytes()
    for bad in (data[:-100], data.replace(b"ann", b"a/n"), b""):
        path = tmp_path / "bad.msgpack"
        path.write_bytes(bad)
        with pytest.raises(DataError, match=r"bad\.msgpack: is damaged"):
            tool("keyframe_set").load(path, recipe, every)


def test_odometry_errors_agree_with_the_covariance(tool, rng):
    drift, count = tool("keyframe_odometry").Drift(), 4000
    steps = se3.exp(rng.normal(0, [0.02, 0.02, 0.15, 0.2, 0.05, 0.02], (count, 6)))
    truth = [np.eye(4)]
    for step in steps:
        yaw = np.arctan2((truth[-1] @ step)[1, 0], (truth[-1] @ step)[0, 0])
        lean = rng.normal(0, 0.2, 3)  # of the body, which does not add up
        turned = se3.so3_exp(np.array([0, 0, yaw])) @ se3.so3_exp(lean)
        truth.append(se3.from_rt(turned, (truth[-1] @ step)[:3, 3]))
    stamps = np.arange(count + 1) * 400_000_000
    T, cov = tool("keyframe_odometry").odometry(np.array(truth), stamps, rng, drift)
    true_step = se3.inverse(np.array(truth)[:-1]) @ np.array(truth)[1:]
    xi = se3.log(se3.inverse(true_step) @ se3.inverse(T[:-1]) @ T[1:])
    squared = np.einsum("ni,nij,nj->n", xi, np.linalg.inv(cov[1:]), xi)
    assert squared.mean() == pytest.approx(6, rel=0.05)
    tilt = np.arccos((T[:, 2, :3] * np.array(truth)[:, 2, :3]).sum(axis=1).clip(-1, 1))
    assert np.sqrt((tilt**2).mean() / 2) == pytest.approx(drift.tilt_rad, rel=0.2)
    drifted = np.linalg.norm(xi[:, 3:], axis=1)
    assert np.median(drifted) == pytest.approx(1.54 * drift.step_m, rel=0.15)  # of three axes


def test_seeds_are_made_once_and_failures_reported(tool, recipe, tmp_path, capsys, monkeypatch):
    command, makes = tool("make_keyframe_sets"), []

    def full(recipe, *rest):
        makes.append(recipe.seed)
        if recipe.seed == 2:
            raise UsageError("there is no room for walk1")
        return make(recipe, *rest)

    make = tool("keyframe_making").make
    monkeypatch.setattr(tool("keyframe_making"), "make", full)
    words = ["--scene", "plain", "--motion", "walk:", "--seconds", "3", "--profile", recipe.profiles[""]]
    words += ["--cache", str(tmp_path)]
    assert command.main([*words, "--seeds", "1:3"]) == 0
    assert command.main([*words, "--seeds", "1:3"]) == 0
    first, full, again, _ = capsys.readouterr().out.splitlines()
    assert first.startswith("plain 1:  walk1 ") and "was there" not in first and "was there" in again
    assert full == "plain 2: left out: there is no room for walk1"
    assert makes == [1, 2, 2]
    assert command.main([*words, "--seeds", "2:3"]) == 2


def test_invalid_arguments_are_refused(tool, capsys):
    main = tool("make_keyframe_sets").main
    assert main(["--scene", "corridor-twinz", "--motion", "walk:"]) == 2
    assert "did you mean 'corridor-twins'" in capsys.readouterr().err
    with pytest.raises(UsageError, match="must be positive"):
        tool("keyframe_set").Spacing(0.0)
    with pytest.raises(SystemExit):
        main(["--scene", "plain", "--motion", "walk:", "--seeds", "5:5"])
