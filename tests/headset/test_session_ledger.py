"""The newest session of each wearer, on disk."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import msgspec
import pytest

from share.errors import ShareError, UsageError
from share.files.locks import folder_locked
from share.headset.session_ledger import LEDGER_FILE, SessionLedger, moment_now
from share.headset.wearer_session import SESSION_S, SessionMoment, WearerSession

NOW = SessionMoment("boot", 100.0, 1.8e9)


def session(number: int, name: str = "ann", edge: str = "a:1") -> WearerSession:
    return WearerSession(name, None, edge, number, NOW.after(SESSION_S), f"{name} {number}")


def test_the_later_one_is_the_newest_also_after_a_start(tmp_path: Path) -> None:
    old, new = session(1), session(2)
    ledger = SessionLedger("a:1", tmp_path)
    assert ledger.is_newest(old)
    ledger.note(old)
    assert ledger.is_newest(new)  # of a ledger that was lost
    ledger.note(new)
    for one in (ledger, SessionLedger("a:1", tmp_path)):
        assert one.is_newest(new) and not one.is_newest(old)
    path = tmp_path / LEDGER_FILE
    assert path.stat().st_mode & 0o777 == 0o600
    path.write_text("{")
    with pytest.raises(UsageError, match=r"headset\.sessions: cannot be read, or is damaged; remove it"):
        SessionLedger("a:1", tmp_path)


def test_edges_of_a_machine_keep_apart_and_keep_what_the_other_wrote(tmp_path: Path) -> None:
    one, other = SessionLedger("a:1", tmp_path), SessionLedger("a:2", tmp_path)
    one.note(session(5))
    other.note(session(9, edge="a:2"))
    assert one.is_newest(session(6)), "a pairing at another edge ends nothing here"
    one.note(session(6))
    for edge, newest in (("a:1", 6), ("a:2", 9)):
        again = SessionLedger(edge, tmp_path)
        assert again.is_newest(session(newest, edge=edge))
        assert not again.is_newest(session(newest - 1, edge=edge))


def test_two_edges_of_one_address_know_of_each_others_sessions(tmp_path: Path) -> None:
    """As in two containers with one home: what one ends, the other ends too, and neither writes it away."""
    one, other = SessionLedger("a:1", tmp_path), SessionLedger("a:1", tmp_path)
    first = one.new_session("ann", None, NOW)
    one.note(first)
    assert other.is_newest(first)
    second = other.new_session("ann", None, NOW)
    assert second.number > first.number
    other.note(second)
    one.note(one.new_session("bob", None, NOW))
    for ledger in (one, other, SessionLedger("a:1", tmp_path)):
        assert ledger.is_newest(second) and not ledger.is_newest(first)


def test_of_two_entries_of_a_wearer_the_newest_counts(tmp_path: Path) -> None:
    newest = session(9)
    for entries in ([session(2), newest], [newest, session(2)]):
        (tmp_path / LEDGER_FILE).write_bytes(msgspec.json.encode(entries))
        ledger = SessionLedger("a:1", tmp_path)
        assert ledger.is_newest(newest) and not ledger.is_newest(session(8))


def test_what_happens_to_the_file_meanwhile_is_said_as_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "headset"
    folder.mkdir()
    ledger = SessionLedger("a:1", folder)
    ledger.note(session(2))
    (folder / LEDGER_FILE).write_text("[{")
    assert not ledger.is_newest(session(1)) and ledger.new_session("ann", None, NOW).number > 2
    with pytest.raises(ShareError, match=r"remove it and headset\.secret .*; as it is, the page cannot"):
        ledger.note(session(3))
    shutil.rmtree(folder)
    assert not ledger.is_newest(session(2))
    with pytest.raises(ShareError, match=r"headset: is gone, .*; start the edge again"):
        ledger.note(session(4))
    assert not ledger.is_newest(session(3)) and not folder.exists()


@pytest.mark.parametrize("step_s", [-10 * 86400.0, -13 * 3600.0, -1.0, 0.0, 13 * 3600.0, 400 * 86400.0])
def test_a_clock_that_is_set_ends_no_session_and_lets_no_old_one_in(tmp_path: Path, step_s: float) -> None:
    ledger = SessionLedger("a:1", tmp_path)
    first = ledger.new_session("ann", None, NOW)
    ledger.note(first)
    later = SessionMoment("boot", NOW.up_s + 60, NOW.wall_s + 60 + step_s)
    assert not first.is_over(later)
    second = ledger.new_session("ann", None, later)
    ledger.note(second)
    for again in (ledger, SessionLedger("a:1", tmp_path)):
        assert again.is_newest(second) and not again.is_newest(first)
    assert not second.is_over(NOW.after(61)), "where the clock is right again"
    assert second.is_over(NOW.after(60 + SESSION_S))


def test_the_longest_ago_are_forgotten(tmp_path: Path) -> None:
    ledger = SessionLedger("a:1", tmp_path)
    ledger._newest = {("a:1", f"n{k}"): session(k + 10, f"n{k}") for k in range(1024)}
    ledger.note(session(5000))
    again = SessionLedger("a:1", tmp_path)
    assert not again.is_newest(session(4999)) and again.is_newest(session(1, "n0"))
    assert not again.is_newest(session(1, "n1"))


def test_what_cannot_be_written_is_said_and_noted(tmp_path: Path) -> None:
    ledger = SessionLedger("a:1", tmp_path)
    (tmp_path / f".{LEDGER_FILE}.new").mkdir()
    with pytest.raises(ShareError, match=r"cannot be written: .*an older session of 'ann' may be good again"):
        ledger.note(session(2))
    assert not ledger.is_newest(session(1))


def test_a_lock_that_another_holds_holds_nobody_up(tmp_path: Path) -> None:
    ledger = SessionLedger("a:1", tmp_path)
    with folder_locked(tmp_path):
        began_s = time.monotonic()
        with pytest.raises(ShareError, match="another process has locked it; after the page's next start"):
            ledger.note(session(2))
        assert time.monotonic() - began_s < 5
    assert not ledger.is_newest(session(1))  # it is noted all the same


def test_the_machine_tells_its_moments() -> None:
    first, second = moment_now(), moment_now()
    assert first.boot == second.boot != "" and 0 <= first.seconds_to(second) < 60
