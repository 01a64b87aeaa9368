"""What ends a live run in good order, and what does not."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator

import pytest

from share.runtime.signals import stop_on_signal


@pytest.fixture(autouse=True)
def as_it_was() -> Iterator[None]:
    """Signals as they are in a terminal, and afterwards as they were."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.SIG_DFL) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def counted() -> tuple[list[int], Callable[[], None]]:
    calls: list[int] = []
    return calls, lambda: calls.append(1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_asks_for_the_end(number: signal.Signals) -> None:
    calls, stop = counted()
    with stop_on_signal(stop):
        signal.raise_signal(number)
    assert calls == [1]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == [signal.SIG_DFL] * 2


def test_a_terminal_that_goes_away_twice_ends_in_good_order_too() -> None:
    calls, stop = counted()
    with stop_on_signal(stop):
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
    signal.raise_signal(signal.SIGHUP)  # while the files are written
    assert calls == [1]


def test_where_nobody_asks_for_the_end_all_is_as_before() -> None:
    with stop_on_signal(counted()[1]):
        pass
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_under_nohup_it_goes_on() -> None:
    calls, stop = counted()
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with stop_on_signal(stop):
        signal.raise_signal(signal.SIGHUP)
    assert calls == []
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
