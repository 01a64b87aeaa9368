"""Who is let in to the headset page."""

from __future__ import annotations

from itertools import count

import pytest

from share.headset.pairing import (
    MAX_WRONG,
    PairingDesk,
    PairingError,
)

SECOND = 10**9


def desk(start: int = 123) -> PairingDesk:
    numbers = count(start)
    return PairingDesk(lambda below: next(numbers) % below)


def test_the_code_lets_in_once_it_is_renewed_by_who_is_let_in() -> None:
    one = desk()
    assert one.code == "00000123"
    one.check("00000123", "a", 0)
    one.renew()
    assert one.code == "00000124"
    with pytest.raises(PairingError, match="not the code"):
        one.check("00000123", "a", 0)


@pytest.mark.parametrize("given", ["", "123", "000001230", "０００００１２３", "00000123 ", "é" * 200])
def test_what_is_not_the_code_is_refused(given: str) -> None:
    with pytest.raises(PairingError, match="not the code"):
        desk().check(given, "a", 0)


def test_a_thousand_wrong_codes_renew_it() -> None:
    one = desk()
    for k in range(MAX_WRONG):
        assert one.code == "00000123"
        with pytest.raises(PairingError, match="not the code"):
            one.check("999999", f"address {k}", k * 60 * SECOND)
    assert one.code == "00000124" and one.wrong_count == MAX_WRONG


def test_an_address_has_three_tries_then_one_in_ten_seconds() -> None:
    one = desk()
    answers = []
    for k in range(40):
        with pytest.raises(PairingError) as refused:
            one.check("999999", "a", k * SECOND)
        answers.append("not the code" in str(refused.value))
    assert sum(answers[:4]) == 3 and sum(answers) == 3 + 3
    one.check(one.code, "b", 40 * SECOND)  # another address is not held up


def test_all_addresses_together_have_few_tries() -> None:
    """A guess hits one of 10^8: in an hour less than once in ten thousand."""
    one, tried = desk(), 0
    for k in range(3600 * 4):
        with pytest.raises(PairingError) as refused:
            one.check("x", f"address {k}", k * SECOND // 4)
        tried += "not the code" in str(refused.value)
    assert 7000 < tried < 7300


def test_wrong_codes_of_four_addresses_hinder_nobody_and_change_nothing() -> None:
    one = desk()
    for k in range(600):
        for address in range(4):
            with pytest.raises(PairingError):
                one.check("x", f"stranger {address}", k * SECOND)
    one.check("00000123", "ann", 600 * SECOND)


@pytest.mark.slow
def test_many_addresses_take_no_memory() -> None:
    one = desk()
    for k in range(5000):
        with pytest.raises(PairingError):
            one.check("x", f"address {k}", 0)
    assert len(one._of_address) <= 1024
    one.check(one.code, "another address", 100 * SECOND)
