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


def test_a_terminate_after_a_hangup_ends_in_order_and_only_the_second_at_once() -> None:
    """As systemd sends both: the second may be pending while the first is handled."""
    calls, stop = counted()

    def stop_while_another_comes() -> None:
        stop()
        if len(calls) == 1:
            signal.raise_signal(signal.SIGTERM)

    with stop_on_signal(stop_while_another_comes):
        signal.raise_signal(signal.SIGHUP)
        assert calls == [1, 1]
        assert callable(signal.getsignal(signal.SIGTERM))  # no SIG_DFL, for one that is pending
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
