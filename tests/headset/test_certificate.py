"""The certificate of the headset page, made or given. Needs the package cryptography."""

from __future__ import annotations

import hashlib
import re
import ssl
import subprocess
import sys
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from share.errors import UsageError
from share.headset.certificate import _key_fault, given_certificate, own_certificate, session_key
from share.headset.headset_page import HeadsetPage
from share.headset.wearers import EdgeAccess

needs_cryptography = pytest.mark.skipif(
    subprocess.run([sys.executable, "-c", "import cryptography"], capture_output=True).returncode != 0,
    reason="cryptography is not installed",
)


@needs_cryptography
def test_it_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    folder = tmp_path / "share" / "headset"
    made = own_certificate(folder, "192.168.1.5")
    assert own_certificate(folder, "10.0.0.1") == made
    assert {one.name: one.stat().st_mode & 0o777 for one in folder.iterdir()} == {
        "headset.crt": 0o600,
        "headset.key": 0o600,
    }
    der = ssl.PEM_cert_to_DER_cert(made.certificate.read_text())
    assert made.fingerprint.replace(":", "").lower() == hashlib.sha256(der).hexdigest()
    assert "localhost" in made.names and made.end > datetime.now(UTC) + timedelta(days=700)
    made.context()


@needs_cryptography
def test_one_that_is_over_is_made_anew_and_a_given_one_refused(tmp_path: Path) -> None:
    old = own_certificate(tmp_path, "::1", datetime.now(UTC) - timedelta(days=729, hours=2))
    assert own_certificate(tmp_path, "::1").fingerprint != old.fingerprint
    own_certificate(tmp_path / "b", "edge.example", datetime.now(UTC) - timedelta(days=800))
    given = (tmp_path / "b" / "headset.crt", tmp_path / "b" / "headset.key")
    with pytest.raises(
        UsageError, match=r"--headset-cert .*: it was valid until 20\d\d-\d\d-\d\d; give a newer"
    ):
        given_certificate(*given)


@needs_cryptography
def test_one_that_is_not_valid_yet_is_made_anew_and_a_given_one_refused(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    early = own_certificate(tmp_path, "::1", now + timedelta(days=30))
    with pytest.raises(
        UsageError,
        match=r"--headset-cert .*: it is valid from 20\d\d-\d\d-\d\d \d\d:\d\d UTC on; give another",
    ):
        given_certificate(early.certificate, early.key, now)
    assert given_certificate(early.certificate, early.key, now + timedelta(days=30)) == early
    assert own_certificate(tmp_path, "::1").fingerprint != early.fingerprint


@needs_cryptography
def test_one_that_ends_within_a_day_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    pytest.importorskip("websockets")
    (tmp_path / "index.html").write_text("x")
    for age, is_said in ((timedelta(days=729, hours=2), True), (timedelta(days=728), False)):
        own = own_certificate(tmp_path / str(is_said), "::1", datetime.now(UTC) - age)
        told: list[str] = []
        given = {"certificate": own.certificate, "key": own.key, "folder": tmp_path}
        with closing(
            HeadsetPage("127.0.0.1:0", EdgeAccess("tcp://127.0.0.1:1"), notify=told.append, **given)  # type: ignore[arg-type]
        ):
            assert [line for line in told if "its certificate ends at" in line] == told[:1] * is_said


@needs_cryptography
def test_a_given_one_that_is_none_is_one_line(tmp_path: Path) -> None:
    own, other = (own_certificate(tmp_path / name, "::1") for name in "ab")
    assert given_certificate(own.certificate, own.key) == own
    (tmp_path / "text").write_text("x")
    (tmp_path / "text").chmod(0o600)
    for certificate, key, said in (
        (own.certificate, other.key, "--headset-key .*is not the key of this certificate"),
        (own.certificate, tmp_path / "text", "--headset-key .*is no key"),
        (own.certificate, tmp_path / "none", "--headset-key .*: cannot be read: No such file"),
        (own.key, own.key, "--headset-cert .*is no certificate"),
        (tmp_path / "text", own.key, "--headset-cert .*is no certificate"),
        (tmp_path, own.key, "--headset-cert .*: cannot be read: it is a folder"),
    ):
        with pytest.raises(UsageError, match=said):
            given_certificate(certificate, key)


@needs_cryptography
def test_a_key_is_refused_for_what_it_is(tmp_path: Path) -> None:
    from cryptography.hazmat.primitives.asymmetric import ec, rsa
    from cryptography.hazmat.primitives.serialization import (
        BestAvailableEncryption,
        Encoding,
        NoEncryption,
        PrivateFormat,
    )

    own = own_certificate(tmp_path / "a", "::1")
    made = rsa.generate_private_key(65537, 2048), ec.generate_private_key(ec.SECP256R1())
    for key, lock, said in (
        (made[0], NoEncryption(), "is a key of another kind than the certificate's"),
        (made[1], NoEncryption(), "is not the key of this certificate"),
        (made[1], BestAvailableEncryption(b"x"), "has a password"),
    ):
        path = tmp_path / "key"
        path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, lock))
        path.chmod(0o600)
        with pytest.raises(UsageError, match=f"--headset-key .*: {said}"):
            given_certificate(own.certificate, path)
    own.key.chmod(0o644)
    with pytest.raises(UsageError, match=r"--headset-key .*: others can read it; `chmod 600"):
        given_certificate(own.certificate, own.key)


def test_openssls_reasons_are_told() -> None:
    for reason, said in (("EE_KEY_TOO_SMALL", "too short"), ("CA_MD_TOO_WEAK", "OpenSSL .*: ca md too weak")):
        error = ssl.SSLError()
        error.reason = reason
        assert re.search(said, _key_fault(error, b""))


@needs_cryptography
def test_a_damaged_own_one_says_how_to_get_another(tmp_path: Path) -> None:
    own = own_certificate(tmp_path, "::1")
    for path in (own.key, own.certificate):
        before = path.read_bytes()
        path.write_bytes(before[:60])
        with pytest.raises(UsageError, match=rf"{path}: is no .*; remove it, and one is made"):
            own_certificate(tmp_path, "::1")
        path.write_bytes(before)
    assert own_certificate(tmp_path, "::1") == own
    tmp_path.chmod(0o777)
    for make in (session_key, lambda folder: own_certificate(folder, "::1")):
        with pytest.raises(UsageError, match=r"others can write to it.*chmod 700"):
            make(tmp_path)


@needs_cryptography
def test_a_key_that_others_can_read_is_refused(tmp_path: Path) -> None:
    own_certificate(tmp_path, "::1").key.chmod(0o640)
    with pytest.raises(UsageError, match=r"others can read it; `chmod 600"):
        own_certificate(tmp_path, "::1")


def test_without_the_package_it_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(UsageError, match=r"cryptography is not installed.*\[headset\].*--headset-cert"):
        own_certificate(tmp_path, "::1")


def test_the_key_of_sessions_stays(tmp_path: Path) -> None:
    key = session_key(tmp_path / "a")
    assert len(key) == 32 and session_key(tmp_path / "a") == key != session_key(tmp_path / "b")
    (tmp_path / "a" / "headset.secret").write_bytes(b"short")
    with pytest.raises(UsageError, match="expected 32 bytes; remove it"):
        session_key(tmp_path / "a")
    (tmp_path / "b" / "headset.secret").chmod(0o644)
    with pytest.raises(UsageError, match="chmod 600"):
        session_key(tmp_path / "b")
