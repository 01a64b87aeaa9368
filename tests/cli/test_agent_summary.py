"""The summary of an agent: keyframes sent and acknowledged, and why some were not."""

from types import SimpleNamespace

import pytest

from share.cli.agent import keyframes_text, unacknowledged_text

TOLD = {
    "edge_sessions": 1, "keyframes": 53, "sent": 50, "unacknowledged": 5, "refusal": None, "connected": True,
    "buffered_at_edge": 0,
}  # fmt: skip

KEYS = "refused: the edge requires keys"
UNSAFE = "could not store them in its map file; see the edge's log"


def report(**reported):
    return {"keyframes": 60, "corrections": 3, "protocol": TOLD | reported}


@pytest.mark.parametrize(
    ("reported", "trouble", "why"),
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
def test_missing_acknowledgements_are_explained(reported, trouble, why):
    run = SimpleNamespace(report=report(**reported), trouble=trouble)
    assert unacknowledged_text(run, "ann", 5.0) == f"the edge did not acknowledge 5 keyframes: {why}"


@pytest.mark.parametrize("reported", [{"unacknowledged": 0}, {"edge_sessions": 0}])
def test_no_explanation_if_all_is_acknowledged_or_no_edge_answered(reported):
    assert unacknowledged_text(SimpleNamespace(report=report(**reported), trouble=None), "ann", 5.0) is None


def test_keyframe_counts_are_printed():
    assert keyframes_text(report(), "T") == "60 keyframes: 50 sent, 48 acknowledged, 3 corrections, T"
    assert keyframes_text(report(edge_sessions=0), "T") == "no edge answered: 60 keyframes not sent"
