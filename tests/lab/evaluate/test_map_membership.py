"""Who shares a map, as corrections come."""

from share.lab.evaluate.real_time import MapMembership


def test_agents_come_together_and_part():
    together = MapMembership()
    assert together.sharing_agents == []
    together.add_correction("a", "a/0")
    together.add_correction("b", "b/0")
    assert together.sharing_agents == []
    together.add_correction("b", "a/0")
    assert together.sharing_agents == ["a", "b"]
    together.add_correction("c", "c/0")
    assert together.sharing_agents == ["a", "b"]
    together.add_correction("a", "c/0")
    assert together.sharing_agents == ["a", "c"]
