"""The last lines of an agent say what was sent, what the edge acknowledged, and why not all was."""

from types import SimpleNamespace

import pytest

from share.cli.agent import _keyframes_text, _unacknowledged_text

TOLD = {
    "edge_sessions": 1, "keyframes": 53, "sent": 50, "unacknowledged": 5, "refusal": None, "connected": True,
    "buffered_at_edge": 0,
}  # fmt: skip

KEYS = "refused: the edge requires keys"
UNSAFE = "could not store them in its map file; see the edge's log"


def report(**told):
    return {"keyframes": 60, "corrections": 3, "protocol": TOLD | told}


@pytest.mark.parametrize(
    ("told", "trouble", "why"),
    [
        ({}, None, "no answer within agent.finish_s (5 s)"),
        (
            {"buffered_at_edge": 4},
            None,
            f"it received 4 of them but {UNSAFE}",
        ),
        ({"connected": False}, None, "the edge is silent"),
        ({"connected": False}, KEYS, KEYS),
        ({"connected": False, "refusal": "too many"}, None, "the edge refuses 'ann': too many"),
    ],
)
def test_why_keyframes_were_never_acknowledged(told, trouble, why):
    run = SimpleNamespace(report=report(**told), trouble=trouble)
    assert _unacknowledged_text(run, "ann", 5.0) == f"the edge did not acknowledge 5 keyframes: {why}"


@pytest.mark.parametrize("told", [{"unacknowledged": 0}, {"edge_sessions": 0}])
def test_nothing_is_said_where_all_is_well_or_there_never_was_an_edge(told):
    assert _unacknowledged_text(SimpleNamespace(report=report(**told), trouble=None), "ann", 5.0) is None


def test_the_last_line_says_what_was_sent():
    assert _keyframes_text(report(), "T") == "60 keyframes: 50 sent, 48 acknowledged, 3 corrections, T"
    assert _keyframes_text(report(edge_sessions=0), "T") == "no edge answered: 60 keyframes not sent"
