"""A map that many runs have left keyframes in: what its report lists, and that they cost nothing."""

from __future__ import annotations

from functools import partial

import pytest
from helpers.hellos import hello_of
from helpers.many_runs import hellos, plain_keyframe, stored_map, work_of

from share.config import Config, EdgeConfig
from share.mapping.mapper import Mapper

NAMES, FEW, MANY = 30, 60, 240
ZOE = "zoe-1"


def restored(count: int, names: int = NAMES) -> Mapper:
    """A map for four agents with `count` absent runs, and zoe with a keyframe; all are indexed."""
    mapper = Mapper(Config(edge=EdgeConfig(max_agents=4)))
    mapper.restore(stored_map(count, names))
    mapper.add_run(ZOE, hello_of("zoe", 1))
    mapper.add_keyframe(ZOE, plain_keyframe(0))
    idle(mapper)
    return mapper


def idle(mapper: Mapper) -> None:
    while (step := mapper.next_lookup()) is not None:
        mapper.finish_step(step, step.run(), 1.0)
    mapper.take_changes()
    mapper.take_events()


@pytest.mark.parametrize("names", [1, NAMES, MANY])
def test_a_report_lists_recent_runs_and_their_maps_and_counts_the_rest(names: int) -> None:
    mapper = restored(MANY, names)
    report = mapper.report()
    assert ZOE in report["agents"] and len(report["agents"]) <= 1 + 4 + 16
    assert {agent["map_id"] for agent in report["agents"].values()} <= report["maps"].keys()
    assert len(report["maps"]) <= 64 + len(report["agents"])
    assert len(report["maps"]) + report["unlisted_maps"] == MANY + 1
    assert sum(report["maps"].values()) + report["unlisted_keyframes"] == MANY + 1


def test_the_largest_maps_are_listed() -> None:
    mapper = restored(MANY)
    first = next(iter(hellos(MANY, NAMES)))
    mapper.set_present(first, True)
    for id_ in (1, 2):
        mapper.add_keyframe(first, plain_keyframe(id_))
    mapper.set_present(first, False)
    for run in list(hellos(MANY, NAMES))[-30:]:
        mapper.set_present(run, True)
        mapper.set_present(run, False)
    report = mapper.report()
    assert first not in report["agents"] and report["maps"][f"{first}/0"] == 3
    assert sum(report["maps"].values()) + report["unlisted_keyframes"] == MANY + 3


def test_one_that_comes_back_is_listed_again() -> None:
    mapper = restored(MANY)
    first = next(iter(hellos(MANY, NAMES)))
    assert first not in mapper.report()["agents"]
    mapper.set_present(first, True)
    mapper.add_keyframe(first, plain_keyframe(1))
    report = mapper.report()
    assert report["agents"][first]["map_id"] == f"{first}/0" and report["maps"][f"{first}/0"] == 2


@pytest.mark.parametrize("names", [1, MANY])
def test_runs_that_are_gone_cost_a_keyframe_nothing(names: int) -> None:
    def work(count: int) -> tuple[int, int, int]:
        mapper = restored(count, min(names, count))
        segment = work_of(partial(mapper.add_keyframe, ZOE, plain_keyframe(1)))
        mapper.add_run("max-1", hello_of("max", 2))
        start = work_of(partial(mapper.add_keyframe, "max-1", plain_keyframe(0)))
        return segment, start, work_of(mapper.next_solve)

    for few, many in zip(work(FEW), work(MANY), strict=True):
        assert many <= 1.05 * few + 50


@pytest.mark.parametrize("names", [1, MANY])
def test_a_report_counts_keyframes_of_each_map_and_looks_no_further(names: int) -> None:
    def work(count: int) -> int:
        mapper = restored(count, min(names, count))
        return work_of(mapper.report)

    assert work(MANY) - work(FEW) < 80 * (MANY - FEW)


def test_a_map_of_many_runs_is_restored_in_time_that_grows_with_them() -> None:
    def work(count: int) -> int:
        stored, mapper = stored_map(count, 1), Mapper(Config())
        return work_of(lambda: mapper.restore(stored))

    assert work(MANY) < 1.1 * MANY / FEW * work(FEW)
