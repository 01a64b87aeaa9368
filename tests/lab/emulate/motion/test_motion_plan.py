import numpy as np
import pytest
from helpers.motion_sim import every, person

from share.errors import UsageError
from share.lab.emulate.motion.motion_plan import plan_motions
from share.lab.emulate.world.occupancy import Occupancy
from share.lab.emulate.world.scenes import make_scene_layout
from share.recordings.trajectory import Trajectory, format_tum
from share.types import AgentKind


@pytest.fixture(scope="module")
def warehouse():
    return make_scene_layout("warehouse", 3, (9, 6, 4))


@pytest.fixture
def recorded(tmp_path):
    stamps = every(person(), 100, 8.0)
    (tmp_path / "head.tum").write_text(format_tum(Trajectory(stamps, person().poses(stamps))))
    return tmp_path / "head.tum"


@pytest.mark.slow
def test_a_recording_two_people_and_a_robot_in_a_warehouse(warehouse, recorded):
    specs = ["walk:", f"rec=tum:{recorded}", "bob=walk:speed=0.7", "robot:"]
    found = plan_motions(specs, warehouse, 10.0, 4)
    assert [a.name for a in found.agents] == ["walk1", "rec", "bob", "robot1"]
    assert [a.body_kind for a in found.agents] == ["person"] * 3 + ["robot"]
    assert found.agents[3].kind is AgentKind.ROBOT and found.agents[0].kind is AgentKind.AR
    assert "ends after 8.0 s" in found.agents[1].notes
    free = Occupancy.from_layout(found.layout)
    places = [a.path.poses(every(a.path, 10, 8.0))[:, :3, 3] for a in found.agents]
    assert all(free.clearance(p).min() > 0.1 for p in places)
    apart = [
        np.linalg.norm(a[:, :2] - b[:, :2], axis=1).min() for i, a in enumerate(places) for b in places[:i]
    ]
    assert min(apart) >= 0.5
    again = plan_motions(specs, warehouse, 10.0, 4)
    for a, b in zip(found.agents, again.agents, strict=True):
        assert np.array_equal(a.path.poses(every(a.path, 5)), b.path.poses(every(b.path, 5)))


@pytest.mark.parametrize(
    ("specs", "says"),
    [
        ([], "no agent is given"),
        (["paper:1", "walk:"], "give it alone"),
        (["x=paper:1"], "without a name"),
        (["a=walk:", "a=robot:"], "two agents are named 'a'"),
    ],
)
def test_an_impossible_plan_is_refused(warehouse, specs, says):
    with pytest.raises(UsageError, match=says):
        plan_motions(specs, warehouse, 10.0, 1)


def test_a_missing_file_is_refused(warehouse, tmp_path):
    with pytest.raises(UsageError, match="no such file"):
        plan_motions([f"tum:{tmp_path}/none.tum"], warehouse, 10.0, 1)


@pytest.mark.slow
def test_an_experiment_of_the_paper_lasts_as_long_as_the_session(warehouse):
    found, whole = (plan_motions(["paper:2"], warehouse, seconds, 1) for seconds in (12.0, 60.0))
    assert found.notes == ("an experiment of the paper lasts 60 s; the session has its first 12 s",)
    for part, all_of_it in zip(found.agents, whole.agents, strict=True):
        assert (part.path.end_ns - part.path.start_ns, whole.notes) == (12 * 10**9, ())
        stamps = every(part.path, 20, 12.0)
        assert (part.path.poses(stamps) == all_of_it.path.poses(stamps)).all()


@pytest.mark.slow
@pytest.mark.long
def test_real_motion_is_placed(warehouse, shared_data):
    folder = shared_data / "motion" / "tumvi" / "room1"
    found = plan_motions([f"ann=tumvi:{folder},start=3", "robot:"], warehouse, 6.0, 1)
    ann = found.agents[0]
    assert ann.path.recorded is not None and ann.T_body_cam0 is not None
    xyz = ann.path.poses(every(ann.path, 20))[:, :3, 3]
    assert Occupancy.from_layout(found.layout).clearance(xyz).min() > 0.15
    assert 1.3 < xyz[:, 2].mean() < 1.9
