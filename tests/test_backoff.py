"""Pauses before a process is started again."""

from share.timing import Backoff

S = 1_000_000_000


def test_restarts_of_a_failing_process_slow_down():
    backoff, now, pauses = Backoff(0), 0, []
    for _ in range(40):
        now += S // 10
        pauses.append(backoff.record_failure(now))
        now += round(pauses[-1] * S)
    assert pauses == [1, 2, 4, 8, 16, 32, *[60] * 34]
    assert backoff.failures == 40


def test_pause_is_reset_after_a_long_life():
    backoff = Backoff(0)
    assert [backoff.record_failure(t * S) for t in (1, 3, 6)] == [1, 2, 4]
    assert backoff.record_failure(10 * S + 10 * S) == 1  # begun at 10 s, and ten seconds old
    assert backoff.failures == 1


def test_pause_does_not_count_as_lifetime():
    backoff, now = Backoff(0), 0
    for _ in range(6):
        now += round(backoff.record_failure(now) * S)
    assert (
        backoff.record_failure(now + 9 * S) == 60
    )  # 41 s after the death before, but 9 after it was started
