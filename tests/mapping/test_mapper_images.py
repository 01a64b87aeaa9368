"""A keyframe's way through the mapper when it comes as an image: describe, align, query, verify."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import pytest
from helpers import textured_planes
from helpers.hellos import NOISE, hello_of
from helpers.textured_planes import CAMERA, T_BODY_CAM, Planes

from share.config import Config, ControlConfig, MergeConfig
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.mapping.candidates import MAX_BACKLOG_CANDIDATES
from share.mapping.graph.solver import PoseGraphSolver
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import MapChange, SaveKeyframe, SaveRun, SaveView
from share.mapping.mapper import Mapper
from share.mapping.recognition.verification import Verification
from share.mapping.steps import AlignStep, DescribeStep, QueryStep, Step, VerifyStep
from share.store.keyframe_archive import KeyframeArchive
from share.store.map_store import MapStore
from share.types import Keyframe, KeyframeImage, View
from share.vision.image_codec import encode_jpeg

ROOM = [[0.1, 0.05, 0.4], [-0.6, 0.0, 0.3], [0.0, 0.7, 0.25]]  # a back wall, a side wall, a floor
COV = np.diag([1e-6] * 3 + [1e-5] * 3)
RIG = Rig(CAMERA, T_BODY_CAM, imu=NOISE)
UP = np.zeros(3)  # unknown


def way(start: float, steps: int) -> Iterator[np.ndarray]:
    """T_world_body (4, 4): the camera moves sideways before the back wall, 5 cm a step."""
    for k in range(steps):
        xi = np.array([0.0, 0.01 * k, 0.0, start + 0.05 * k, 0.02 * (k % 2), 0.01 * k])
        yield se3.exp(xi) @ se3.inverse(T_BODY_CAM)


@cache
def keyframes(
    place: Planes, start: float, seed: int, steps: int = 4
) -> tuple[tuple[np.ndarray, Keyframe], ...]:
    """One run: true poses, and what it sends; its odom is anywhere."""
    rng, found = np.random.default_rng(seed), list[tuple[np.ndarray, Keyframe]]()
    T_odom_world = se3.exp(rng.normal(0, [0.1, 0.1, 0.1, 1, 1, 1]))
    for k, T in enumerate(way(start, steps)):
        image = textured_planes.image_view(place, T, rng, rho_sigma=0.005).source
        T_odom = T_odom_world @ T
        T_ref = se3.inverse(found[-1][1].T_odom_body) @ T_odom if k else T_odom
        sent = Keyframe(k, k - 1, k * 10**8, T_ref, COV, T_odom, UP, 0.0, View.empty(), k - 1, image)
        found.append((T, sent))
    return tuple(found)


@pytest.fixture(scope="module")
def place() -> Planes:
    return Planes(ROOM, seed=3)


def mapper_of(*names: str, control: ControlConfig | None = None, enter_m: float = 0.025) -> Mapper:
    mapper = Mapper(Config(control=control or ControlConfig(), merge=MergeConfig(enter_m=enter_m)))
    for k, name in enumerate(names):
        mapper.add_run(name, replace(hello_of(name, k + 1), rig=RIG))
    return mapper


_SOLVERS: WeakKeyDictionary[Mapper, PoseGraphSolver] = WeakKeyDictionary()


def work(mapper: Mapper) -> list[tuple[Step, object]]:
    """All steps that are due, with their results."""
    done, solver = [], _SOLVERS.setdefault(mapper, PoseGraphSolver())
    while (step := mapper.next_lookup()) is not None:
        done.append((step, step.run()))
        mapper.finish_step(step, done[-1][1], 1.0)
        while (solve := mapper.next_solve()) is not None:
            mapper.finish_step(solve, solve.run(solver), 1.0)
    return done


def kinds(done: list[tuple[Step, object]]) -> list[str]:
    return [step.kind for step, _ in done]


@pytest.mark.long
def test_two_agents_join_by_their_images_and_are_then_aligned_by_the_map(place: Planes) -> None:
    """The first loops are found by looks; once the maps are one, by the map's poses."""
    mapper = mapper_of("ann", "bob")
    ann, bob = keyframes(place, -0.1, 1), keyframes(place, 0.0, 2, steps=7)
    for _, sent in ann:
        mapper.add_keyframe("ann", sent)
        alone = work(mapper)
        assert kinds(alone)[:2] == ["describe", "place"]
    aligned = []
    for _, sent in bob:
        mapper.add_keyframe("bob", sent)
        done = work(mapper)
        [view] = [outcome for step, outcome in done if isinstance(step, DescribeStep)]
        assert len(view) > 200
        assert all(step.query_image is not None for step, _ in done if isinstance(step, VerifyStep))
        aligned.append([outcome for step, outcome in done if isinstance(step, AlignStep)])
        if not aligned[-1]:
            assert "place" in kinds(done)
    assert mapper.atlas.map_sizes() == {"ann/0": 11}
    assert aligned[0] == [] and aligned[-1]
    assert all(isinstance(outcome, Verification) for outcomes in aligned for outcome in outcomes)
    poses = dict(zip(*_all_poses(mapper), strict=True))
    T_map_world = poses["bob", 6] @ se3.inverse(bob[6][0])
    for name, run in (("ann", ann), ("bob", bob)):
        for T, sent in run:
            off = se3.log(se3.inverse(T_map_world @ T) @ poses[name, sent.id])
            assert np.linalg.norm(off[3:]) < 0.004
            assert np.degrees(np.linalg.norm(off[:3])) < 0.15
    assert mapper.report()["failed_steps"] == 0


@pytest.mark.long
def test_a_pending_merge_does_not_end_a_search_while_others_wait(place: Planes) -> None:
    """It needs loops of several keyframes on both sides, and soon: those at hand may be all there will be."""
    mapper = mapper_of("ann", "bob")
    for _, sent in keyframes(place, -0.1, 1):
        mapper.add_keyframe("ann", sent)
    work(mapper)
    for _, sent in keyframes(place, 0.0, 2, steps=2):
        mapper.add_keyframe("bob", sent)
    newest = [step for step, _ in work(mapper) if isinstance(step, VerifyStep)][:MAX_BACKLOG_CANDIDATES]
    assert [mapper.atlas.key(step.node_id) for step in newest] == [KeyframeKey("bob", 1)] * len(newest)
    assert mapper.atlas.map_sizes() == {"ann/0": 6}


@pytest.mark.long
def test_who_waits_is_compared_with_others_alone_without_the_maps_pose_and_again(place: Planes) -> None:
    """Images aligned from a wrong pose would confirm it."""
    mapper = mapper_of("ann", "bob", enter_m=1e-6)
    for _, sent in keyframes(place, -0.1, 1):
        mapper.add_keyframe("ann", sent)
    work(mapper)
    alone, waiting = list[Step](), list[Step]()
    for _, sent in keyframes(place, 0.0, 2, steps=6):
        mapper.add_keyframe("bob", sent)
        steps = waiting if len(mapper.atlas.map_sizes()) == 1 else alone
        steps += [step for step, _ in work(mapper)]
    assert mapper.atlas.map_sizes() == {"ann/0": 10}
    assert waiting and not any(isinstance(step, AlignStep) for step in waiting)
    verified = [step for step in alone + waiting if isinstance(step, VerifyStep)]
    of_bob = [step for step in verified if mapper.atlas.key(step.node_id).agent == "bob"]
    assert {mapper.atlas.key(step.candidate_id).agent for step in of_bob} == {"ann"}
    assert len(of_bob) == len({(step.node_id, step.candidate_id) for step in of_bob})
    first = [step.candidate_id for step in of_bob if mapper.atlas.key(step.node_id).id == 0]
    assert len(first) == 4  # three at first, and the last of ann's once bob is known to be there


def _all_poses(mapper: Mapper) -> tuple[list[tuple[str, int]], np.ndarray]:
    saved = mapper.atlas.all_poses()
    return [tuple(key) for key in saved.keys], saved.T_map_body


@pytest.mark.long
def test_where_the_map_is_right_only_every_fourth_is_compared_by_its_looks(
    place: Planes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And all, as soon as there is another map to find; each reviews what was joined."""
    mapper = mapper_of("ann", "bob", "eve")
    acceptance, reviewed = mapper.atlas.loop_acceptance, list[int]()
    review = acceptance.review_joins
    monkeypatch.setattr(
        acceptance, "review_joins", lambda node_id: reviewed.append(node_id) or review(node_id)
    )
    for _, sent in keyframes(place, -0.1, 1):
        mapper.add_keyframe("ann", sent)
    work(mapper)
    bob = keyframes(place, 0.0, 2, steps=12)
    looks = []
    for _, sent in bob[:8]:
        mapper.add_keyframe("bob", sent)
        done = work(mapper)
        looks.append((kinds(done), done[0][0].node_id))
    joined = looks[["align" in done for done, _ in looks].index(True) :]
    assert len(joined) >= 4
    for done, node_id in joined:
        assert "align" in done and ("place" in done) == (node_id % 4 == 0)
        assert "place" in done or done[-1] == "describe"  # when nothing waits
    assert sorted(reviewed) == list(range(12))
    elsewhere = keyframes(Planes(ROOM, seed=9), 0.0, 3, steps=1)
    mapper.add_keyframe("eve", elsewhere[0][1])
    work(mapper)
    for _, sent in bob[8:10]:
        mapper.add_keyframe("bob", sent)
        assert {"align", "place"} <= set(kinds(work(mapper)))


@pytest.mark.long
def test_what_the_merge_gate_skips_is_not_aligned(place: Planes) -> None:
    """With an eagerness of nothing it skips all once there was a merge; the gate needs no image."""
    mapper = mapper_of("ann", "bob", control=ControlConfig(eagerness=0.0))
    for name, run in (("ann", keyframes(place, -0.1, 1)), ("bob", keyframes(place, 0.0, 2, steps=7))):
        for _, sent in run:
            mapper.add_keyframe(name, sent)
            done = work(mapper)
            assert "align" not in kinds(done)
    merges = mapper.report()["merges"]
    assert mapper.atlas.map_sizes() == {"ann/0": 11}
    assert 0 < merges["skipped"] < merges["requested"] and merges["done"] > 0
    events = mapper.take_events()
    assert len(events) == merges["skipped"] and {event.event for event in events} == {"merge skipped"}


def test_a_keyframe_that_waits_is_described_for_the_queries_of_others(place: Planes) -> None:
    """Also of one that is not looked up itself."""
    mapper = mapper_of("ann")
    [(_, sent)] = keyframes(place, 0.0, 1, steps=1)
    mapper.add_keyframe("ann", sent)
    while mapper.queries.next_query() is not None:
        pass
    [(step, view)] = work(mapper)
    assert isinstance(step, DescribeStep) and len(view) > 200
    assert mapper.next_lookup() is None


@pytest.mark.long
def test_an_alignment_that_fails_costs_its_candidate_only(place: Planes) -> None:
    """The other candidates are aligned, and the keyframe is looked up."""
    mapper = mapper_of("ann", "bob")
    for name, run in (("ann", keyframes(place, -0.1, 1)), ("bob", keyframes(place, 0.0, 2, steps=7))):
        for _, sent in run[:6]:
            mapper.add_keyframe(name, sent)
            work(mapper)
    mapper.add_keyframe("bob", run[6][1])
    done, map_events = [], []
    while (step := mapper.next_lookup()) is not None:
        done.append(step)
        is_first = [one.kind for one in done].count("align") == 1 and step.kind == "align"
        map_events += mapper.finish_step(step, RuntimeError("bad") if is_first else step.run(), 1.0)
    assert [step.kind for step in done].count("align") >= 2
    failed = [map_event for map_event in map_events if map_event.event == "step failed"]
    assert [map_event.agent for map_event in failed] == ["bob"]
    assert "align: RuntimeError: bad" in failed[0].reason
    assert mapper.report()["failed_steps"] == 1


@pytest.mark.long
def test_where_all_alignments_fail_a_keyframe_is_compared_by_its_looks(place: Planes) -> None:
    mapper = mapper_of("ann", "bob")
    for name, run in (("ann", keyframes(place, -0.1, 1)), ("bob", keyframes(place, 0.0, 2, steps=6))):
        for _, sent in run[:5]:
            mapper.add_keyframe(name, sent)
            work(mapper)
    mapper.add_keyframe("bob", run[5][1])
    seen = []
    while (step := mapper.next_lookup()) is not None:
        seen.append(step.kind)
        mapper.finish_step(step, RuntimeError("bad") if step.kind == "align" else step.run(), 1.0)
    assert "align" in seen and "place" in seen and seen.index("align") < seen.index("place")
    assert mapper.report()["failed_steps"] == seen.count("align")


@pytest.mark.parametrize("fails", [False, True], ids=["", "fails"])
@pytest.mark.parametrize("at", [DescribeStep, QueryStep])
def test_a_keyframe_may_be_removed_while_it_is_looked_up(
    place: Planes, at: type, fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper = mapper_of("ann")
    monkeypatch.setattr(mapper.atlas.culling, "is_removable", lambda node_id: node_id == 1)
    for _, sent in keyframes(place, 0.0, 1, steps=3):
        mapper.add_keyframe("ann", sent)
    step = mapper.next_lookup()
    while not (isinstance(step, at) and step.node_id == 1):
        mapper.finish_step(step, step.run(), 1.0)
        step = mapper.next_lookup()
    mapper.remove_keyframes([step.node_id])
    is_removed = step.node_id not in mapper.views.by_node
    mapper.finish_step(step, ValueError("bad") if fails else step.run(), 1.0)
    rest = work(mapper)
    assert is_removed and all(other.node_id != step.node_id for other, _ in rest)
    assert mapper.report()["failed_steps"] == fails
    assert len(mapper.views.index) == len(mapper.views.by_node) == 2


def narrow() -> tuple[Rig, KeyframeImage]:
    """A camera one pixel wide: what OpenCV cannot resize."""
    camera = Camera(1, 480, 385.0, 385.0, 0.0, 239.5)
    jpeg = np.frombuffer(encode_jpeg(np.zeros((480, 1), np.uint8), 50), np.uint8)
    return Rig(camera, np.eye(4), imu=NOISE), replace(KeyframeImage.empty(), jpeg=jpeg)


def test_an_image_in_which_no_features_can_be_found_is_tried_once() -> None:
    rig, image = narrow()
    mapper = Mapper(Config())
    mapper.add_run("eve", replace(hello_of("eve", 1), rig=rig))
    sent = Keyframe(0, -1, 0, np.eye(4), COV, np.eye(4), UP, 0.0, View.empty(), -1, image)
    mapper.add_keyframe("eve", sent)
    map_events = []
    for _ in range(20):
        if (step := mapper.next_lookup()) is None:
            break
        try:
            result = step.run()
        except Exception as error:
            result = error
        map_events += mapper.finish_step(step, result, 1.0)
    else:
        pytest.fail("it is tried for ever")
    assert [map_event.event for map_event in map_events].count("step failed") == 1
    assert mapper.report()["failed_steps"] == 1


def test_a_damaged_image_costs_the_keyframe_its_features_only_and_is_said_once(
    place: Planes, capfd: pytest.CaptureFixture[str]
) -> None:
    """Not by libjpeg, which would write a line to stderr for each."""
    mapper = mapper_of("ann")
    for k, (_, keyframe) in enumerate(keyframes(place, 0.0, 1, steps=2)):
        broken = keyframe.image.jpeg.copy()
        broken[-900 if k else 2 : -2] = 255 if k else 0
        mapper.add_keyframe("ann", replace(keyframe, image=replace(keyframe.image, jpeg=broken)))
    done, map_events = [], []
    while (step := mapper.next_lookup()) is not None:
        done.append((step, step.run()))
        map_events += mapper.finish_step(step, done[-1][1], 1.0)
    assert [len(view) for step, view in done if isinstance(step, DescribeStep)] == [0, 0]
    assert mapper.report()["failed_steps"] == 0
    said = [map_event.reason for map_event in map_events if map_event.event == "odometry suspect"]
    assert sorted(said) == [f"keyframe {k}: its image is damaged: without it" for k in (0, 1)]
    assert capfd.readouterr().err == ""
    mapper.remove_keyframes([done[0][0].node_id])
    assert len(mapper.views.index) == len(mapper.views.by_node)


@pytest.mark.long
def test_a_restored_map_is_recognised_by_the_views_in_its_file(place: Planes, tmp_path: Path) -> None:
    """Nothing is described again, but the keyframe whose view is not in the file."""
    first, changes = mapper_of("ann"), list[MapChange]()
    ann = [sent for _, sent in keyframes(place, -0.1, 1)]
    for sent in ann:
        first.add_keyframe("ann", sent)
        changes.append(SaveKeyframe("ann", sent))
        work(first)
    described = [change for change in first.take_changes() if isinstance(change, SaveView)]
    assert [change.key.id for change in described] == [sent.id for sent in ann]
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        hello = replace(hello_of("ann", 1), rig=RIG)
        store.write([SaveRun("ann", hello), *changes, *described[:-1], first.current_poses()])
    second = Mapper(Config(), KeyframeArchive(path))
    second.restore(MapStore.read(path).load())
    done = work(second)
    assert [step.node_id for step, _ in done if isinstance(step, DescribeStep)] == [len(ann) - 1]
    assert [change.key.id for change in second.take_changes() if isinstance(change, SaveView)] == [ann[-1].id]
    second.add_run("bob", replace(hello_of("bob", 2), rig=RIG))
    for _, sent in keyframes(place, 0.0, 2, steps=7):
        second.add_keyframe("bob", sent)
        work(second)
    assert second.atlas.map_sizes() == {"ann/0": 11}
    assert second.report()["failed_steps"] == 0
