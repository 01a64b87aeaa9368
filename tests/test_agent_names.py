"""Valid names of agents."""

from __future__ import annotations

from unicodedata import normalize

import pytest
from helpers.hellos import hello_of

from share.agent_names import natural_order
from share.recordings.session import is_agent_name


@pytest.mark.parametrize(
    "name",
    [
        *("n" * n for n in range(54, 65)),
        *("é" * 64, "日" * 64, "ü" * 58),
        *("a", "ann", "a b", "AR-1", "lab_2.west", "ann@lab", "cart #3 (left)", "a+b", "..", "-", "NUL"),
        *(
            "Jürgen",
            "佐々木マリー",
            "한국어",
            "Привет",
            "אבא",
            "سلمى",
            "देव",
            "सिंह",
            "น้ำ",
            "ที่",
            "x̌x̌",
            "٣",
            "0",
        ),
    ],
)
def test_valid_names_are_accepted(name: str) -> None:
    assert hello_of(name, 1).name == name


@pytest.mark.parametrize(
    "name",
    [
        *("", " ", "n" * 65, " ann", "ann ", "a  b", "a/b", "a\\b", "a\nb", "a\0b", "a\tb"),
        *("eve': all is well; agent 'hope", "eve: ok", 'eve"', "eve`", "eve, bob", "<b>", "%s", "~"),
        "hope\u3164",  # Hangul filler: a letter that shows nothing
        *("hope\u115f", "hope\u1160", "hope\uffa0", "hope\u034f", "hope\ufe0f", "hope\U000e0100"),
        *("hope\u2800", "hope\u00a0", "a\u2003b", "hope\u200b", "hope\u202e", "hope\u00ad"),
        *("e" + "\u0301" * 63, "ho\u0338\u0338\u0338pe", "\u0301hope", "hope-\u0301", "hope\u20dd"),
        *("eve\u02bc", "eve\u02d0", "eve\ua789", "eve\ua78c", "eve\u2019", "eve\u201d", "eve\ua4fd", "²"),
        *("\ud800", "\ue000", "\u0378", "🙂"),
    ],
    ids=ascii,
)
def test_invalid_names_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"^name: .*; use 1 to 64 letters, digits") as refused:
        hello_of(name, 1)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 140
    assert not is_agent_name(name)


def test_names_are_compared_in_normal_form() -> None:
    assert hello_of(normalize("NFD", "Jürgen"), 1).name == "Jürgen"


def test_numbers_in_names_sort_as_numbers():
    names = ["agent10", "agent2", "Ann", "7up", "agent2b", "agent", "agent1/3"]
    assert sorted(names, key=natural_order) == [
        "7up",
        "Ann",
        "agent",
        "agent1/3",
        "agent2",
        "agent2b",
        "agent10",
    ]
