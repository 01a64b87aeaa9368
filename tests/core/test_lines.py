"""Lines that a peer causes are few."""

from share.protocol.edge_trust import Lasting

S = 10**9


def test_a_trouble_that_comes_and_goes_is_said_once_until_it_was_gone_for_a_minute() -> None:
    lasting = Lasting()
    said = [t for t in range(0, 600, 2) if lasting.begins("wants keys", t * S)]
    assert said == [0]
    assert not lasting.begins("wants keys", 655 * S)
    assert lasting.begins("another key", 656 * S)
    assert lasting.begins("wants keys", 716 * S)


def test_troubles_of_any_number_are_remembered_in_a_bounded_number() -> None:
    lasting = Lasting()
    assert all(lasting.begins(str(k), k) for k in range(1000))
    assert not lasting.begins("999", 1000)
    assert len(lasting._there) <= 16
