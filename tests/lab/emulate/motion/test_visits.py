"""`visit:` walks to places by the clock; who goes round and round keeps off."""

import numpy as np
import pytest

from share.errors import UsageError
from share.lab.emulate.motion.motion_plan import plan_motions
from share.lab.emulate.motion.spec import VisitSpec, parse_motion
from share.lab.emulate.world.scenes import make_scene_layout

SECONDS = 60.0
BY_THE_CLOCK = "ann=visit:6.2 2.2 8;7.8 3.8 25;6.3 3.9 60"
ROUND = "bob=visit:5 1;9 1;9 5;5 5,speed=0.5"


@pytest.fixture(scope="module")
def room():
    return make_scene_layout("warehouse", 8101, (10.0, 8.0, 4.0))


def test_a_visit_is_read():
    name, spec = parse_motion("ann=visit:1 2 8;3 4.5 20,speed=1.1")
    assert (name, spec) == ("ann", VisitSpec("1 2 8;3 4.5 20", 1.1))
    assert spec.stops == [(1.0, 2.0, 8.0), (3.0, 4.5, 20.0)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("visit:", "place '' is not X Y"),
        ("visit:1 2 8", "fewer than two places"),
        ("visit:1 2;3 4 5", "a time for each place"),
        ("visit:1 2 9;3 4 5", "rising"),
        ("visit:1 nan;3 4", "not finite"),
        ("visit:1 2;3 4,speed=9", "0.2 to 2 m/s"),
    ],
)
def test_a_wrong_visit_is_refused(text, says):
    with pytest.raises(UsageError, match=says):
        parse_motion(text)


@pytest.mark.long
def test_people_stand_where_and_when_they_are_to_and_keep_apart(room):
    plan = plan_motions((BY_THE_CLOCK, ROUND), room, SECONDS, 8101)
    seconds = np.arange(0.0, SECONDS, 0.1)
    ann, bob = (
        one.path.poses(one.path.start_ns + np.round(seconds * 1e9).astype(np.int64))[:, :2, 3]
        for one in plan.agents
    )
    for (x, y), first_s, last_s in (((6.2, 2.2), 0, 7), ((7.8, 3.8), 13, 24), ((6.3, 3.9), 29, 59)):
        there = np.linalg.norm(ann - (x, y), axis=1)[(seconds > first_s) & (seconds < last_s)]
        assert there.max() < 0.35, (x, y)
    assert np.linalg.norm(ann - bob, axis=1).min() > 0.6
    walked = np.linalg.norm(np.diff(bob, axis=0), axis=1).sum()
    assert 0.8 * 0.5 * SECONDS < walked < 1.1 * 0.5 * SECONDS


@pytest.mark.long
def test_a_way_round_on_which_somebody_stands_is_refused(room):
    standing = "ann=visit:5 1 20;9 1 60"
    with pytest.raises(UsageError, match="blocked by those who stand on it"):
        plan_motions((standing, "bob=visit:9 1;9.01 1.4;5 1,speed=1.9"), room, SECONDS, 8101)
