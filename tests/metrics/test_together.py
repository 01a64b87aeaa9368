"""Who shares a map, as corrections come."""

from share.lab.evaluate.together import Together


def test_agents_come_together_and_part():
    together = Together()
    assert together.agents == []
    together.corrected("a", "a/0")
    together.corrected("b", "b/0")
    assert together.agents == []
    together.corrected("b", "a/0")
    assert together.agents == ["a", "b"]
    together.corrected("c", "c/0")
    assert together.agents == ["a", "b"]
    together.corrected("a", "c/0")
    assert together.agents == ["a", "c"]
