"""Which signals end a live run cleanly."""

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
def test_the_first_signal_calls_stop(number: signal.Signals) -> None:
    calls, stop = counted()
    with stop_on_signal(stop):
        signal.raise_signal(number)
    assert calls == [1]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == [signal.SIG_DFL] * 2


def test_a_second_hangup_is_ignored() -> None:
    calls, stop = counted()
    with stop_on_signal(stop):
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
    signal.raise_signal(signal.SIGHUP)  # while the files are written
    assert calls == [1]


def test_handlers_are_restored_after_the_block() -> None:
    with stop_on_signal(counted()[1]):
        pass
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_an_ignored_hangup_stays_ignored() -> None:
    calls, stop = counted()
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with stop_on_signal(stop):
        signal.raise_signal(signal.SIGHUP)
    assert calls == []
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
