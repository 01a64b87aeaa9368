"""How many candidates are tried while other queries wait, and while none does."""

import pytest

from share.mapping import candidates
from share.mapping.candidates import CandidateSearch


def tried(search: CandidateSearch, hurries: list[bool], hits: set[int]) -> list[int]:
    """Candidates tried. hurries: whether others wait, at each step. hits: those that are verified."""
    out = []
    for in_a_hurry in hurries:
        candidate = search.next_candidate(in_a_hurry)
        if candidate is None:
            break
        out.append(candidate)
        if candidate in hits:
            search.count_verified()
    return out


@pytest.fixture(autouse=True)
def two_in_a_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "MAX_BACKLOG_CANDIDATES", 2)


def search() -> CandidateSearch:
    return CandidateSearch(range(8))


def test_all_candidates_are_tried_until_three_are_verified():
    assert tried(search(), [False] * 20, set()) == list(range(8))
    assert tried(search(), [False] * 20, {1, 2, 5, 6}) == [
        0,
        1,
        2,
        3,
        4,
        5,
    ]


def test_a_hurried_search_tries_two_and_ends_at_one():
    assert tried(search(), [True] * 20, set()) == [0, 1]
    assert tried(search(), [True] * 20, {0}) == [0]


def test_a_query_that_arrives_meanwhile_ends_the_search():
    assert tried(search(), [False] * 4 + [True] * 9, set()) == [
        0,
        1,
        2,
        3,
    ]
    assert tried(search(), [False, True, True], {0}) == [0]
    assert tried(search(), [False, True, True], set()) == [0, 1]
