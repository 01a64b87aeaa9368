"""Lines that a peer causes are few."""

from share.protocol.reply_validation import FaultDeduplicator

S = 10**9


def test_a_trouble_that_comes_and_goes_is_said_once_until_it_was_gone_for_a_minute() -> None:
    lasting = FaultDeduplicator()
    said = [t for t in range(0, 600, 2) if lasting.is_new("wants keys", t * S)]
    assert said == [0]
    assert not lasting.is_new("wants keys", 655 * S)
    assert lasting.is_new("another key", 656 * S)
    assert lasting.is_new("wants keys", 716 * S)


def test_troubles_of_any_number_are_remembered_in_a_bounded_number() -> None:
    lasting = FaultDeduplicator()
    assert all(lasting.is_new(str(k), k) for k in range(1000))
    assert not lasting.is_new("999", 1000)
    assert lasting.is_new("980", 1001)  # forgotten, although it was seen less than a minute ago
