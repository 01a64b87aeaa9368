"""What an agent says of an edge that lets it in and keeps it out, again and again."""

from itertools import cycle
from types import SimpleNamespace

from share.protocol.reply_validation import FaultDeduplicator
from share.runtime.agent import AgentRun


def test_an_edge_that_changes_its_mind_is_complained_of_once():
    said, states = [], cycle(["refused: the edge requires keys", None])
    run = AgentRun.__new__(AgentRun)
    run._link, run._notify = SimpleNamespace(trouble=lambda: next(states)), said.append
    run._troubles, run.trouble = FaultDeduplicator(), None
    for _ in range(65):
        run._notify_trouble()
    assert said == ["refused: the edge requires keys"]
    assert run.trouble == said[0]  # and that is what is wrong at the end
