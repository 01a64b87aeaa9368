"""Points of a sweep, their settings, and its heat map."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from share.config import Config
from share.errors import ConfigError, UsageError
from share.lab.evaluate.real_time import RunOptions
from share.lab.evaluate.statistics import MEASURES
from share.lab.evaluate.sweep import SweepAxis, config_at, grid, heat_map, plan_sweep, random_points
from share.recordings.session import Session

KP, KI = SweepAxis.parse("control.kp=0.2,0.8"), SweepAxis.parse("control.ki=0,0.1,1e-3")


@pytest.mark.parametrize(
    "text",
    ["control.kp", "kp=1", "control.kp=", "a.b.c=1", "control.kp=1:x", "control.kp=3:1", "control.kp=1:2:3"],
)
def test_malformed_axes_are_refused(text):
    with pytest.raises(UsageError, match=f"--set {text}: "):
        SweepAxis.parse(text)


def test_a_grid_is_every_combination():
    assert grid([KP, KI]) == [(p, i) for p in ("0.2", "0.8") for i in ("0", "0.1", "1e-3")]
    with pytest.raises(UsageError, match="a range needs --random N"):
        grid([SweepAxis.parse("control.kp=1:2")])


def test_random_points_are_log_uniform_and_repeatable():
    axes = [SweepAxis.parse("control.kp=0.1:10"), SweepAxis.parse("control.ki=0:2"), KI]
    points = random_points(axes, 2000, seed=0)
    kp, ki = (np.array([float(point[k]) for point in points]) for k in (0, 1))
    assert 0.1 <= kp.min() < 0.12 < 8 < kp.max() <= 10
    assert np.mean(kp < 1) == pytest.approx(0.5, abs=0.04)
    assert np.mean(ki < 1) == pytest.approx(0.5, abs=0.04)
    assert {point[2] for point in points} == set(KI.values)
    assert random_points(axes, 20, seed=0) == points[:20]
    assert random_points(axes, 20, seed=1) != points[:20]


def test_a_point_is_played_once_however_often_it_is_named_or_drawn():
    assert grid([SweepAxis.parse("control.kp=1,1,2")]) == [("1",), ("2",)]
    assert sorted(random_points([KP, KI], 50, seed=0)) == sorted(grid([KP, KI]))


def test_a_point_changes_its_settings_and_no_other():
    tied = SweepAxis.parse("control.rate_min_hz+control.rate_max_hz=2,3")
    config = config_at(Config(), [KP, tied], ("0.2", "3"))
    assert config.control.kp == 0.2
    assert (config.control.rate_min_hz, config.control.rate_max_hz) == (3, 3)
    assert config.edge == Config().edge
    assert config.control.kd == Config().control.kd
    with pytest.raises(ConfigError, match="unknown key 'kpp'; did you mean 'kp'"):
        config_at(Config(), [SweepAxis.parse("control.kpp=1")], ("1",))


def test_every_run_has_a_folder_of_its_own():
    sessions = [Session(Path(name), {}, {}) for name in ("a", "b")]
    runs = plan_sweep(
        sessions, [KP, KI], grid([KP, KI]), range(2), RunOptions("share"), Path("out"), Config()
    )
    assert len({one.out for one, _ in runs}) == len(runs) == 2 * 6 * 2
    assert {one.options.seed for one, _ in runs} == {0, 1}
    assert all(one.config.control.kp == float(point[0]) for one, point in runs)
    again = plan_sweep(sessions, [KP], grid([KP]), range(1), RunOptions("share"), Path("out"), Config())
    assert not {one.out for one, _ in again} & {one.out for one, _ in runs}  # of another sweep


def test_a_policy_of_the_sweep_is_played():
    axis = SweepAxis.parse("edge.policy=equal,linear")
    options = RunOptions("share")
    runs = plan_sweep([Session(Path("a"), {}, {})], [axis], grid([axis]), [0], options, Path("out"), Config())
    assert [one.options.policy for one, _ in runs] == ["equal", "linear"]
    other = plan_sweep([Session(Path("a"), {}, {})], [KP], [("1",)], [0], options, Path("out"), Config())
    assert [one.options.policy for one, _ in other] == ["share"]


def test_heat_is_the_mean_over_all_other_settings():
    third = SweepAxis.parse("control.kd=0,1")
    measure = MEASURES[0].name
    rows = [
        {
            "settings": {"control.kp": p, "control.ki": i, "control.kd": d},
            "means": {measure: SimpleNamespace(value=float(p) + 10 * float(i) + 100 * float(d))},
        }
        for p, i, d in grid([KP, KI, third])
    ]
    found = heat_map([KP, KI, third], rows, measure)
    assert found.shape == (2, 3)
    assert found[1, 1] == pytest.approx(0.8 + 1 + 50)
    assert math.isnan(heat_map([KP, KI], rows[:1], measure)[1, 1])
