import dataclasses

import pytest

from share.errors import UsageError
from share.lab.emulate.sensor.effects import NO_EFFECTS, Effects, parse_effects


def test_words_change_single_effects():
    effects = parse_effects(["noise=off", "drops=0.02", "time_offset_ms=-8"])
    assert effects == Effects(noise=False, drops=0.02, time_offset_ms=-8.0)
    assert parse_effects(["none", "noise=on"]) == dataclasses.replace(NO_EFFECTS, noise=True)
    assert not any(value is True for value in dataclasses.asdict(NO_EFFECTS).values())


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("drop=0.1", "did you mean 'drops'"),
        ("fog=1", "known: none, noise,"),
        ("noise", "noise=on or noise=off"),
        ("noise=0.5", "noise=on or noise=off"),
        ("drops=many", "expected a number, found 'many'"),
        ("drops=1", "must lie in 0 .. 0.9"),
        ("drops=nan", "not finite"),
        ("drop_burst=0.5", "must lie in 1 .. 20"),
    ],
)
def test_an_invalid_effect_is_refused_in_one_line(word: str, says: str):
    with pytest.raises(UsageError, match=r"^effect ") as refused:
        parse_effects([word])
    assert says in str(refused.value) and "\n" not in str(refused.value)


def test_a_value_of_another_type_is_refused():
    with pytest.raises(UsageError, match="effect noise: expected on or off"):
        Effects(noise=0.5)  # type: ignore[arg-type]
