"""Pauses before a process is started again."""

from share.timing import Backoff

S = 1_000_000_000


def test_who_dies_at_once_is_started_ever_more_seldom():
    backoff, now, pauses = Backoff(0), 0, []
    for _ in range(40):
        now += S // 10
        pauses.append(backoff.record_failure(now))
        now += round(pauses[-1] * S)
    assert pauses == [1, 2, 4, 8, 16, 32, *[60] * 34]
    assert backoff.failures == 40


def test_who_was_well_begins_anew():
    backoff = Backoff(0)
    assert [backoff.record_failure(t * S) for t in (1, 3, 6)] == [1, 2, 4]
    assert backoff.record_failure(10 * S + 10 * S) == 1  # begun at 10 s, and ten seconds old
    assert backoff.failures == 1


def test_the_pause_is_no_part_of_its_life():
    backoff, now = Backoff(0), 0
    for _ in range(6):
        now += round(backoff.record_failure(now) * S)
    assert (
        backoff.record_failure(now + 9 * S) == 60
    )  # 41 s after the death before, but 9 after it was started
