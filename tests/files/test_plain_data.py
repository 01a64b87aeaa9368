from dataclasses import dataclass

import numpy as np
import pytest

from share.errors import ConfigError
from share.plain_data import MAX_NUMBER, from_mapping
from share.types import F64


@dataclass(frozen=True)
class Inner:
    count: int
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Outer:
    size: float
    pair: tuple[float, float]
    inner: Inner
    T: F64
    many: tuple[Inner, ...] = ()
    maybe: Inner | None = None
    switch: bool = False

    def __post_init__(self) -> None:
        if self.size <= 0:
            raise ValueError(f"size: {self.size:g} must be positive")


WHOLE = {"size": 2, "pair": [1, "2e-3"], "inner": {"count": 3, "names": ["a"]}, "T": np.eye(4).tolist()}


def outer(**changes: object) -> Outer:
    return from_mapping(Outer, {**WHOLE, **changes}, "f.yaml", lowest=-MAX_NUMBER)


def test_values_defaults_and_nested_sections_are_read():
    found = outer(many=[{"count": 1}, {"count": 2}], switch=True)
    assert (found.size, found.pair) == (2.0, (1.0, 0.002))
    assert found.inner == Inner(3, ("a",))
    assert found.many == (Inner(1), Inner(2))
    assert found.maybe is None and found.switch
    assert np.array_equal(found.T, np.eye(4))
    assert outer(maybe={"count": 7}).maybe == Inner(7)
    assert outer(maybe=None).maybe is None


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"sise": 2}, "f.yaml: unknown key 'sise'; did you mean 'size'?"),
        ({"x": 2}, "f.yaml: unknown key 'x'; known: size, pair,"),
        ({"inner": {}}, "f.yaml: inner: key 'count' is missing"),
        ({"inner": {"count": 1.5}}, "f.yaml: inner: count: expected a whole number, found 1.5"),
        ({"inner": {"count": 1, "names": "a"}}, "f.yaml: inner: names: expected a list"),
        ({"inner": {"count": 1, "names": [1]}}, "f.yaml: inner: names[0]: expected a word"),
        ({"inner": 5}, "f.yaml: inner: expected keys and values"),
        ({"many": [{"cont": 1}]}, "f.yaml: many[0]: unknown key 'cont'; did you mean 'count'?"),
        ({"pair": [1, 2, 3]}, "f.yaml: pair: expected a list of 2"),
        ({"size": True}, "f.yaml: size: expected a number, found True"),
        ({"size": "big"}, "f.yaml: size: expected a number, found 'big'"),
        ({"size": float("nan")}, "f.yaml: size: expected a number from -1e+09 to 1e+09, found nan"),
        ({"size": -1}, "f.yaml: size: -1 must be positive"),
        ({"switch": 1}, "f.yaml: switch: expected true or false, found 1"),
        ({"T": [[1, 0], [0, 1]]}, "f.yaml: T: expected a 4x4 matrix"),
    ],
)
def test_an_invalid_value_is_refused_by_file_and_key(changes: dict[str, object], says: str):
    with pytest.raises(ConfigError) as refused:
        outer(**changes)
    assert str(refused.value).startswith(says) and "\n" not in str(refused.value)


def test_a_missing_key_is_named():
    with pytest.raises(ConfigError, match=r"f\.yaml: key 'size' is missing"):
        from_mapping(Outer, {k: v for k, v in WHOLE.items() if k != "size"}, "f.yaml")
