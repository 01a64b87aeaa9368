"""A part of what measure_emulation.py in tools/experiments measures, and plans of the paper's experiments."""

import json

import pytest
from click.testing import CliRunner
from helpers import paper_plans
from helpers.experiments import experiment

from share.cli.main import cli
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.render.context import missing_reason
from share.lab.emulate.session import make_session

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("number", range(1, 6))
@pytest.mark.parametrize("scene", ["warehouse", "firestation"])
def test_the_papers_experiments_fit_into_every_room(scene, number, seed):
    row = paper_plans.of_plan(scene, number, seed)
    assert "failed" not in row, row["failed"]
    assert max(abs(off) for off in row["length_off"]) <= 2.0  # percent
    user1, user2, robot = row["floor_m"]
    assert min(user1, user2) > 0.25 and robot > 0.17
    assert min(row["head_m"]) > 0.17
    assert row["people_m"] >= 0.6 and row["robot_m"] >= 0.5


@pytest.mark.skipif(missing_reason() is not None, reason=f"cannot draw: {missing_reason()}")
@pytest.mark.parametrize("motion", ["euroc:euroc/V1_02_medium,start=12", "tumvi:tumvi/room1,start=5"])
def test_a_real_gyro_turns_as_the_pictures_do(motion, shared_data, tmp_path):
    kind, _, folder = motion.partition(":")
    recipe = SessionRecipe("warehouse", (f"a={kind}:{shared_data}/motion/{folder}",), seconds=5.0)
    row = experiment("measure_emulation").of_session(str(make_session(recipe, tmp_path / "session") / "a"))
    assert row["fit_mm"] < 4.0
    assert row["fit_imu_turn_sigmas"] < 3.0 and row["fit_imu_velocity_sigmas"] < 3.0
    assert row["turn_most_mrad"] > 10  # it does turn
    assert row["turn_imu_path_mrad"] < 0.1
    assert row["turn_imu_images_mrad"] < 0.4
    assert abs(row["shift_ms"]) < 1.0
    assert row["track_lost_s"] < 0.5 and row["track_ate_cm"] < 3.0


@pytest.mark.skipif(missing_reason() is not None, reason=f"cannot draw: {missing_reason()}")
def test_a_fisheye_pair_is_tracked(tmp_path):
    """15 s of such walks gave 0.33 and 0.19 cm; 0.72 and 1.13 where a pixel at the edge counted as one in the
    middle."""
    recipe = SessionRecipe("warehouse", ("a=walk:",), seconds=6.0, seed=11, profiles={"": "tumvi"})
    session = make_session(recipe, tmp_path / "session")
    done = CliRunner().invoke(cli, ["track", str(session / "a"), "--json"], catch_exceptions=False)
    reported = json.loads(done.stdout)
    assert reported["tracked"] > 100 and reported["lost_s"] == 0
    assert reported["ate_m"] < 0.006
