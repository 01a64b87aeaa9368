"""A mapper's process that waits for a room."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from share.runtime import spare_mapper
from share.runtime.spare_mapper import SpareMapper


class FakeProcess:
    def __init__(self, on_answer: Callable[[Any], None], on_death: Callable[[str], None], delay_s: float):
        self.on_answer, self.delay_s, self.is_dead, self.is_closed = on_answer, delay_s, False, False

    def attach(self, on_answer: Callable[[Any], None], on_death: Callable[[str], None]) -> None:
        self.on_answer = on_answer

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[FakeProcess]:
    made: list[FakeProcess] = []

    def make(on_answer: Any, on_death: Any, delay_s: float = 0.0) -> FakeProcess:
        made.append(FakeProcess(on_answer, on_death, delay_s))
        return made[-1]

    monkeypatch.setattr(spare_mapper, "start_mapper_process", make)
    return made


def test_who_takes_it_has_its_answers_and_another_is_prepared(made: list[FakeProcess]) -> None:
    spare, answers = SpareMapper(), [].append
    spare.prepare()
    spare.prepare()
    assert len(made) == 1
    assert spare.take(answers, print) is made[0]  # type: ignore[comparison-overlap]
    assert made[0].on_answer is answers
    assert len(made) == 2
    spare.close()
    assert [one.is_closed for one in made] == [False, True]
    spare.prepare()
    assert len(made) == 2


def test_without_one_that_lives_and_may_start_now_a_new_one_is_started(made: list[FakeProcess]) -> None:
    spare = SpareMapper()
    assert spare.take(print, print) is made[0]  # type: ignore[comparison-overlap]
    spare.prepare()
    assert spare.take(print, print, 3.0) is made[2]  # type: ignore[comparison-overlap]
    assert made[2].delay_s == 3.0
    made[1].is_dead = True
    assert spare.take(print, print) is made[3]  # type: ignore[comparison-overlap]
    assert spare.take(print, print) is made[4]  # type: ignore[comparison-overlap]
    assert made[4].delay_s > 0.0  # it was prepared when the one before was taken
