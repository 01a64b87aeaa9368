"""Which runs are present, which is the latest of a name, and which ones a report lists."""

from __future__ import annotations

from helpers.many_runs import work_of

from share.mapping.agent_runs import AgentRuns


def left(runs: AgentRuns, *keys: str) -> None:
    """Runs that come, `name-number`, and leave one after the other."""
    for key in keys:
        runs.add(key, key.partition("-")[0])
        runs.set_present(key, False)


def test_a_report_lists_who_is_there_the_latest_of_names_and_who_left_last() -> None:
    runs = AgentRuns()
    runs.add("here-1", "here")
    left(runs, "old-1", *(f"n{k}-1" for k in range(5)), *(f"ann-{k}" for k in range(40)))
    left_last = [f"ann-{k}" for k in range(24, 40)]
    assert runs.listed(3) == ["here-1", "n3-1", "n4-1", *left_last]
    runs.add("eve-1", "eve")
    assert runs.listed(3) == ["here-1", "n4-1", *left_last, "eve-1"]


def test_one_that_comes_back_is_the_latest_and_listed() -> None:
    runs = AgentRuns()
    left(runs, *(f"ann-{k}" for k in range(40)))
    assert "ann-3" not in runs.listed(1) and runs.is_latest("ann-39")
    assert runs.set_present("ann-3", True)
    assert runs.is_latest("ann-3") and not runs.is_latest("ann-39")
    assert runs.listed(1)[0] == "ann-3" and list(runs.present()) == ["ann-3"]
    assert not runs.set_present("ann-3", True)


def test_one_that_was_heard_from_counts_as_having_left_last() -> None:
    runs = AgentRuns()
    left(runs, *(f"ann-{k}" for k in range(40)))
    assert not runs.set_present("ann-3", False)
    assert runs.listed(1) == ["ann-3", *(f"ann-{k}" for k in range(25, 40))]
    assert runs.is_latest("ann-39") and runs.is_superseded("ann-3")


def test_the_one_before_a_removed_run_is_the_latest_and_names_go_with_their_runs() -> None:
    runs = AgentRuns()
    left(runs, "ann-1", "ann-2", "bob-1")
    runs.set_present("ann-1", True)
    runs.remove("ann-1")
    assert runs.is_latest("ann-2") and runs.is_name_absent("ann")
    runs.remove("ann-2")
    runs.remove("bob-1")
    assert (len(runs), runs.listed(9), runs.presence_order()) == (0, [], {})
    assert not runs.is_absent("ann-2") and runs.name("ann-2") == "ann-2"


def test_one_that_was_never_added_goes_by_its_key() -> None:
    runs = AgentRuns()
    assert not runs.is_absent("ann") and not runs.is_name_absent("ann")
    assert runs.set_present("ann", False)
    assert runs.is_absent("ann") and runs.listed(1) == ["ann"]
    runs.add("ann", "Ann Other")
    assert runs.name("ann") == "Ann Other" and len(runs) == 1


def test_nothing_takes_longer_with_more_runs() -> None:
    def work(count: int) -> int:
        runs = AgentRuns()
        left(runs, *(f"n{k % (count // 2)}-{k}" for k in range(count)))

        def all_of_it() -> None:
            runs.add("new", "n1")
            runs.listed(8)
            runs.set_present("new", False)
            runs.set_present("n1-1", True)
            runs.is_superseded("new")
            runs.listed(8)
            runs.remove("new")

        return work_of(all_of_it)

    assert work(1000) <= 1.05 * work(100)
