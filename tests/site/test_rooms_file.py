from __future__ import annotations

import pytest

from share.config import Config
from share.errors import ConfigError, UsageError
from share.site.rooms_file import read_rooms


def written(tmp_path, text: str):
    path = tmp_path / "rooms.yaml"
    path.write_text(text)
    return path


def test_rooms_in_their_order_with_what_is_their_own(tmp_path):
    plan = read_rooms(
        written(
            tmp_path,
            "rooms:\n  kitchen: {map: k.sqlite}\n  lab: {agents: [ann, bob], max_agents: 8}\n  hall:\n",
        )
    )
    assert list(plan.rooms) == ["kitchen", "lab", "hall"]
    assert plan.map_file("kitchen") == tmp_path / "k.sqlite"
    assert plan.map_file("hall") is None
    assert plan.rooms["lab"].agents == ("ann", "bob")
    settings = plan.rooms["lab"].settings(Config())
    assert settings.edge.max_agents == 8
    assert settings.edge.max_keyframes == Config().edge.max_keyframes


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rooms:\n  lab: {}\n  lab: {}\n", "lab"),
        ("rooms: {}\n", "0 rooms"),
        ("room: {lab: {}}\n", "did you mean 'rooms'"),
        ("rooms: [lab]\n", "rooms"),
        ("rooms: {lab: {maps: a}}\n", "did you mean 'map'"),
        ("rooms: {lab: {map: a}, hall: {map: ./a}}\n", "'lab' and 'hall' have the same map"),
        ("rooms: {lab: {agents: [ann, ann]}}\n", "twice"),
        ("rooms: {'lab\\n': {}}\n", "lab"),
        ('rooms: {"a/b": {}}\n', "a/b"),
        ("rooms: {lab: {max_agents: 0}}\n", "max_agents"),
        ("rooms: {lab: {max_agents: 1.5}}\n", "max_agents"),
        ("schema: 2\nrooms: {lab: {}}\n", "schema 2"),
        ("rooms: {lab: {}", "not valid YAML"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(tmp_path, text, said):
    with pytest.raises((ConfigError, UsageError)) as caught:
        read_rooms(written(tmp_path, text))
    line = str(caught.value)
    assert said in line
    assert "rooms.yaml" in line
    assert "\n" not in line


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UsageError, match=r"none\.yaml: cannot be read"):
        read_rooms(tmp_path / "none.yaml")
