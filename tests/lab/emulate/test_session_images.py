"""Agents are in each other's images; a session drawn with OpenGL is the same for any number of processes."""

import numpy as np
import pytest
from helpers.small_session import files, small_profile, small_recipe

from share.geometry import se3
from share.lab.emulate.recipe import no_progress
from share.lab.emulate.render.context import missing_reason
from share.lab.emulate.session import make_session
from share.lab.emulate.stage import RoomStage, T_body_camera, keep_room, prepare_session
from share.lab.emulate.world.room_files import open_renderer
from share.runtime.source import open_source

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(missing_reason() is not None, reason=f"cannot draw: {missing_reason()}"),
]
CHEST_M = 0.3  # below the eyes


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return small_profile(tmp_path_factory.mktemp("profile"))


def nearest_view(stage, who, other, times):
    """The time at which the other is nearest to the middle of the image and in front, and its place (px)."""
    a, b = stage.actors[who], stage.actors[other]
    T_cam_world = se3.inverse(a.path.poses(times) @ T_body_camera(a.rig, "cam0"))
    chest = b.path.poses(times - a.path.start_ns + b.path.start_ns)[:, :3, 3] - (0, 0, CHEST_M)
    p = np.einsum("nij,nj->ni", T_cam_world[:, :3, :3], chest) + T_cam_world[:, :3, 3]
    ahead = p[:, 2] / np.linalg.norm(p, axis=1)
    k = int(np.argmax(ahead))
    return times[k], a.rig.cam0.project(p[k : k + 1])[0], ahead[k]


def test_two_facing_agents_see_each_other(small, tmp_path):
    recipe = small_recipe(small, "ann=walk:", "bob=walk:", scene="whitewall", seconds=20.0, seed=2)
    prepared = prepare_session(recipe, tmp_path / "room", no_progress)
    keep_room(prepared, no_progress)
    stage: RoomStage = prepared.stage
    renderer = open_renderer(stage.room)
    for who, other in ((0, 1), (1, 0)):
        actor = stage.actors[who]
        times = np.arange(actor.path.start_ns, actor.path.end_ns, 10**8)
        when, at, ahead = nearest_view(stage, who, other, times)
        assert ahead > 0.9
        (view,) = stage.views(who, np.array([when]))
        assert list(view.part_poses) == [stage.actors[other].name]
        seen = view.camera_view(T_body_camera(actor.rig, "cam0"))
        alone = type(seen)(seen.T_world_cam)
        camera = actor.rig.cam0
        difference = np.abs(renderer.radiance(camera, [seen]) - renderer.radiance(camera, [alone]))
        nearer = renderer.depth(camera, seen) < renderer.depth(camera, alone) - 0.05
        assert nearer[tuple(np.rint(at[::-1]).astype(int))], "the other stands where it should be"
        assert 20 < nearer.sum() < 0.5 * nearer.size
        assert difference[nearer].mean() > 5
        assert np.median(difference[~nearer]) == 0


@pytest.mark.slow
def test_a_drawn_session_is_the_same_for_any_number_of_processes(small, tmp_path):
    recipe = small_recipe(small, "ann=walk:", "bob=walk:", "robot:", scene="warehouse", seconds=4.0)
    one, two = (make_session(recipe, tmp_path / str(n), workers=n) for n in (1, 2))
    assert files(one) == files(two)
    for name in ("ann", "bob", "robot1"):
        grays = [m.payload.load() for m in open_source(str(one / name)).measurements() if m.stream == "cam0"]
        assert len(grays) == 40
        assert min(gray.std() for gray in grays) > 15
