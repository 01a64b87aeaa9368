"""Which agents share a map, by their corrections."""

from share.lab.evaluate.real_time import MapMembership


def test_agents_of_one_map_share_it_until_they_separate():
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
