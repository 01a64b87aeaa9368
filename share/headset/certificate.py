"""The certificate of the headset page: made on first use and kept, or given.

Nobody has signed it: a wearer compares its fingerprint with what the edge printed, once, and accepts it.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import socket
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from share.errors import UsageError, install_hint
from share.files.locks import folder_locked
from share.files.reading import MB, open_regular, read_bytes
from share.files.writing import write_private, xdg_folder

_CERTIFICATE, _KEY, _SECRET = "headset.crt", "headset.key", "headset.secret"
_VALID_DAYS = 730
_MAX_BYTES = MB
_SECRET_BYTES = 32


@dataclass(frozen=True)
class PageCertificate:
    """Files of a certificate and its key (PEM). fingerprint: SHA-256, in pairs of digits. names: of whom it
    is. begin, end: when it is valid."""

    certificate: Path
    key: Path
    fingerprint: str
    names: tuple[str, ...]
    begin: datetime
    end: datetime

    def ends_soon(self, now: datetime) -> bool:
        """Return whether it ends within a day."""
        return self.end <= now + timedelta(days=1)

    def context(self) -> ssl.SSLContext:
        """Return the settings of a TLS server with it. Raises UsageError."""
        text = _read(self.key, f"--headset-key {self.key}")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        try:
            # an empty password: else OpenSSL asks the terminal for one
            context.load_cert_chain(self.certificate, self.key, password="")
        except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
            raise UsageError(f"--headset-key {self.key}: {_key_fault(error, text)}") from None
        return context


def _key_fault(error: Exception, text: bytes) -> str:
    """Return why OpenSSL takes no key and its certificate. text: of the key's file."""
    reason = getattr(error, "reason", None) or ""
    if reason == "KEY_VALUES_MISMATCH":
        return "is not the key of this certificate"
    if reason in ("NO_CERTIFICATE_ASSIGNED", "KEY_TYPE_MISMATCH"):
        return "is a key of another kind than the certificate's, so it is not the key of this certificate"
    if reason == "EE_KEY_TOO_SMALL":
        return "is too short to be safe; take ECDSA P-256, or RSA of 2048 bits or more"
    if reason:
        return f"OpenSSL does not take it with its certificate: {reason.lower().replace('_', ' ')}"
    if b"ENCRYPTED" in text:
        return "has a password, which nobody could give at the edge's start; give it without one"
    return "is no key (PEM)"


def default_folder() -> Path:
    """Return $XDG_CONFIG_HOME/share/headset, or ~/.config/share/headset."""
    return xdg_folder("XDG_CONFIG_HOME", ".config") / "share" / "headset"


def given_certificate(certificate: Path, key: Path, now: datetime | None = None) -> PageCertificate:
    """Return the certificate in two files. Raises UsageError."""
    found = _described(certificate, key, f"--headset-cert {certificate}")
    _check_secret(key, f"--headset-key {key}")
    now, where = now or datetime.now(UTC), f"--headset-cert {certificate}"
    if found.end <= now:
        raise UsageError(f"{where}: it was valid until {found.end:%Y-%m-%d}; give a newer one")
    if found.begin > now:
        text = f"it is valid from {found.begin:%Y-%m-%d %H:%M} UTC on; give another, or set the clock"
        raise UsageError(f"{where}: {text}")
    found.context()
    return found


def own_certificate(folder: Path, host: str, now: datetime | None = None) -> PageCertificate:
    """Return the certificate in `folder`, made if there is none or it is not valid now. host: that is
    listened on. Raises UsageError, also where it has to be made without the package `cryptography`."""
    now = now or datetime.now(UTC)
    certificate, key = folder / _CERTIFICATE, folder / _KEY
    _make_folder(folder)
    with folder_locked(folder):
        if certificate.exists() and key.exists():
            _check_secret(key, str(key))
            try:
                found = _described(certificate, key, str(certificate))
                found.context()
            except UsageError as error:
                text = str(error).removeprefix("--headset-key ")
                raise UsageError(f"{text}; remove it, and one is made with its key") from None
            if found.begin <= now and not found.ends_soon(now):
                return found
        _make(certificate, key, host, now)
    return _described(certificate, key, str(certificate))


def session_key(folder: Path) -> bytes:
    """Return the key that sessions are signed with, made on first use: wearers stay paired when the edge
    starts again. Raises UsageError."""
    path = folder / _SECRET
    _make_folder(folder)
    with folder_locked(folder):
        if not path.exists():
            write_private(path, secrets.token_bytes(_SECRET_BYTES), replaces=True)
        _check_secret(path, str(path))
        data = _read(path, str(path))
    if len(data) != _SECRET_BYTES:
        raise UsageError(f"{path}: expected {_SECRET_BYTES} bytes; remove it, and one is made")
    return data


def _described(certificate: Path, key: Path, where: str) -> PageCertificate:
    text = _read(certificate, where).decode("ascii", "replace")
    try:
        first = text[text.index(ssl.PEM_HEADER) :].partition(ssl.PEM_FOOTER)[0]
        der = ssl.PEM_cert_to_DER_cert(f"{first.strip()}\n{ssl.PEM_FOOTER}\n")
        names, begin, end = _names_and_times(certificate)
    except ValueError:
        raise UsageError(f"{where}: is no certificate (PEM)") from None
    digits = hashlib.sha256(der).hexdigest().upper()
    pairs = ":".join(digits[k : k + 2] for k in range(0, len(digits), 2))
    return PageCertificate(certificate, key, pairs, names, begin, end)


def _names_and_times(certificate: Path) -> tuple[tuple[str, ...], datetime, datetime]:
    """Return the names in a certificate, and from and until when it is valid. Raises ValueError."""
    try:
        # Python's own tests read certificates by this; its public doors read only those of a peer
        about = ssl._ssl._test_decode_cert(str(certificate))  # type: ignore[attr-defined]
    except OSError:  # ssl.SSLError too
        raise ValueError from None
    names = tuple(str(value) for kind, value in about.get("subjectAltName", ()) if kind == "DNS")
    begin, end = (
        datetime.fromtimestamp(ssl.cert_time_to_seconds(about[name]), UTC)
        for name in ("notBefore", "notAfter")
    )
    return names, begin, end


def _make(certificate: Path, key: Path, host: str, now: datetime) -> None:
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.asymmetric import ec
    except ImportError:
        raise UsageError(
            f"--headset: {install_hint('cryptography', 'headset')}; or give --headset-cert and --headset-key"
        ) from None
    name = socket.gethostname()
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, f"SHARE edge on {name}"[:64])])
    named: list[x509.GeneralName] = [x509.DNSName(one) for one in ("localhost", name, f"{name}.local")]
    for address in dict.fromkeys(("127.0.0.1", "::1", host)):
        try:
            named.append(x509.IPAddress(ip_address(address)))
        except ValueError:
            named.append(x509.DNSName(address))
    private = ec.generate_private_key(ec.SECP256R1())
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(private.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))  # a headset's clock may be behind
        .not_valid_after(now + timedelta(days=_VALID_DAYS))
        .add_extension(x509.SubjectAlternativeName(named), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(private, hashes.SHA256())
    )
    pem = private.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_private(key, pem, replaces=True)
    write_private(certificate, made.public_bytes(serialization.Encoding.PEM), replaces=True)


def _read(path: Path, where: str) -> bytes:
    try:
        return read_bytes(path, _MAX_BYTES)
    except OSError as error:
        raise UsageError(f"{where}: cannot be read: {error.strerror or error}") from None


def _check_secret(path: Path, where: str) -> None:
    """Raises UsageError if others than the owner can read or change a file."""
    try:
        with open_regular(path, _MAX_BYTES) as file:
            is_open = os.fstat(file.fileno()).st_mode & 0o077
    except OSError as error:
        raise UsageError(f"{where}: cannot be read: {error.strerror or error}") from None
    if is_open:
        raise UsageError(f"{where}: others can read it; `chmod 600 {path}`")


def _make_folder(folder: Path) -> None:
    """Raises UsageError, also where others can change what is in it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {error.strerror}") from None
    if status.st_mode & 0o022:
        raise UsageError(f"{folder}: others can write to it, and so give it other keys; `chmod 700 {folder}`")
