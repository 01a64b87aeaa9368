"""The newest session of each wearer, on disk."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from share.errors import ShareError, UsageError
from share.files.locks import folder_locked
from share.headset.pairing import SESSION_S, WearerSession
from share.headset.session_ledger import LEDGER_FILE, SessionLedger


def test_the_later_one_is_the_newest_also_after_a_start(tmp_path: Path) -> None:
    old, new = WearerSession("ann", None, 1000.0, "a"), WearerSession("ann", None, 1001.0, "b")
    ledger = SessionLedger(tmp_path)
    assert ledger.is_newest(old)
    ledger.note(old, 0.0)
    assert ledger.is_newest(new)  # of a ledger that was lost
    ledger.note(new, 0.0)
    for one in (ledger, SessionLedger(tmp_path)):
        assert one.is_newest(new) and not one.is_newest(old)
    path = tmp_path / LEDGER_FILE
    assert path.stat().st_mode & 0o777 == 0o600
    path.write_text("{")
    with pytest.raises(UsageError, match=r"headset\.sessions: cannot be read, or is damaged; remove it"):
        SessionLedger(tmp_path)


def test_two_edges_of_a_machine_keep_what_the_other_wrote(tmp_path: Path) -> None:
    one, other = SessionLedger(tmp_path), SessionLedger(tmp_path)
    one.note(WearerSession("ann", None, 1000.0, "a"), 0.0)
    other.note(WearerSession("bob", None, 1000.0, "b"), 0.0)
    assert not SessionLedger(tmp_path).is_newest(WearerSession("ann", None, 999.0, "x"))
    one.note(WearerSession("cid", None, 5000.0, "c"), 2000.0)
    assert "ann" not in (tmp_path / LEDGER_FILE).read_text()  # it is over


def test_a_clock_that_was_put_back_makes_no_older_session(tmp_path: Path) -> None:
    ledger = SessionLedger()
    assert ledger.end_of_new("ann", 5.0) == 5.0 + SESSION_S
    ledger.note(WearerSession("ann", None, 5.0 + SESSION_S, "a"), 5.0)
    assert ledger.end_of_new("ann", 4.0) > 5.0 + SESSION_S


def test_what_cannot_be_written_is_said_and_noted(tmp_path: Path) -> None:
    ledger = SessionLedger(tmp_path)
    (tmp_path / f".{LEDGER_FILE}.new").mkdir()
    with pytest.raises(ShareError):
        ledger.note(WearerSession("ann", None, 1000.0, "a"), 0.0)
    assert not ledger.is_newest(WearerSession("ann", None, 999.0, "x"))


def test_a_lock_that_another_holds_holds_nobody_up(tmp_path: Path) -> None:
    ledger = SessionLedger(tmp_path)
    with folder_locked(tmp_path):
        began_s = time.monotonic()
        with pytest.raises(BlockingIOError):
            ledger.note(WearerSession("ann", None, time.time() + 60, "n"), time.time())
        assert time.monotonic() - began_s < 5
    assert ledger.is_newest(WearerSession("ann", None, 0.0, "n"))  # it is noted all the same
