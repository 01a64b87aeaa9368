"""The headset page of an edge: its address, its process, and what that tells (docs/do/headset.md)."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec

from share.errors import UsageError, install_hint
from share.files.writing import writable_dir
from share.headset.certificate import (
    PageCertificate,
    default_folder,
    given_certificate,
    own_certificate,
    session_key,
)
from share.headset.measures import HEADSET_TABLE, ServerReport, begin_table
from share.headset.mounts import read_mounts
from share.headset.page_requests import FOLDER
from share.headset.session_ledger import SessionLedger
from share.headset.wearers import EdgeAccess
from share.net.http_guard import listen, served_address
from share.net.transport import Address, parse_address
from share.view.feed import ViewFeed
from share.view.page_process import PageProcess, ServedPage, begin_process, end_process

COLLECT_S = 1 / 60  # between messages to the process, as between those of poses to a page
_NICENESS = 5  # below the edge, above the live room
_TITLE = "headset page"


def page_address(text: str) -> tuple[Address, bool]:
    """Return the address of --headset and whether it is to be encrypted. Raises UsageError."""
    scheme, marker, rest = text.partition("://")
    where = rest if marker else text
    if marker and scheme not in ("http", "https"):
        raise UsageError(f"--headset {text}: expected HOST:PORT, or http://127.0.0.1:PORT for `adb reverse`")
    address = served_address(where.rstrip("/"))
    if scheme == "http" and marker and not address.local:
        raise UsageError(
            f"--headset {text}: a browser gives WebXR to an encrypted page only; without http:// it is one"
        )
    return address, not (marker and scheme == "http")


def page_certificate(
    certificate: Path | None, key: Path | None, is_encrypted: bool, host: str
) -> PageCertificate | None:
    """Return the certificate that is given, else our own; None without encryption. Raises UsageError."""
    if (certificate is None) != (key is None):
        raise UsageError("--headset-cert, --headset-key: give both, or leave both out")
    if not is_encrypted:
        if certificate is not None:
            raise UsageError("--headset-cert: http:// is not encrypted; leave it out, or leave out http://")
        return None
    if certificate is not None and key is not None:
        return given_certificate(certificate, key)
    return own_certificate(default_folder(), host)


class HeadsetPage(ServedPage):
    """A process that serves the page, and the feed to it. One that ends by itself is started again. `close`
    may be repeated.

    address: as of `page_address`. access: of the clients of wearers. mounts: as of `read_mounts`. out: folder
    for what pages measure. folder: with the page's files. notify: is called with lines, from another thread.
    Raises UsageError for what is malformed or missing, TransportError if the address cannot be bound.
    """

    def __init__(
        self,
        address: str,
        access: EdgeAccess,
        *,
        certificate: Path | None = None,
        key: Path | None = None,
        mounts: Sequence[str] = (),
        out: Path | None = None,
        folder: Path = FOLDER,
        notify: Callable[[str], None] = lambda text: None,
    ) -> None:
        if find_spec("websockets") is None:
            raise UsageError(f"--headset: {install_hint('websockets', 'headset')}")
        from share.headset.server import HeadsetSettings

        where, is_encrypted = page_address(address)
        self.certificate = page_certificate(certificate, key, is_encrypted, where.host)
        table = None if out is None else begin_table(writable_dir(out, HEADSET_TABLE) / HEADSET_TABLE)
        known_mounts = read_mounts(mounts)
        session_key(default_folder())  # what is wrong is said before the page is served
        SessionLedger("", default_folder())
        listener, bound = listen(where)
        self.endpoint = str(bound).removeprefix("tcp://")
        self.scheme = "https" if is_encrypted else "http"
        shown = str(Address(shown_host(bound.host), bound.port)).removeprefix("tcp://")
        self.url = f"{self.scheme}://{shown}/"
        if self.certificate is not None and self.certificate.ends_soon(datetime.now(UTC)):
            end = f"{self.certificate.end:%Y-%m-%d %H:%M} UTC"
            notify(f"headset page: its certificate ends at {end}; give a newer one")
        self._notify, self._decoder = notify, msgspec.json.Decoder(ServerReport)
        self._report: dict[str, Any] = {}
        self._has_keys = access.keys_folder is not None
        feed = ViewFeed(collect_s=COLLECT_S, has_images=False)
        settings = HeadsetSettings(
            access,
            where.host,
            self.endpoint,
            self.certificate,
            default_folder(),
            time.monotonic(),
            known_mounts,
            table,
            folder,
        )
        process = PageProcess(_TITLE, _run, (listener, settings), notify, feed.reconnect, self._hear)
        super().__init__(listener, feed, process)

    def report(self) -> dict[str, Any]:
        """Return the field `headset` of the edge's report: its address, the code, and its wearers. Safe from
        any thread."""
        fingerprint = None if self.certificate is None else self.certificate.fingerprint
        return {"address": self.url, "fingerprint": fingerprint, **self._report}

    def shown_report(self, is_guarded: bool) -> dict[str, Any]:
        """Return the report for readers. is_guarded: they have given a token. A code opens what its wearer's
        key does, so with keys nobody else gets it."""
        report = self.report()
        return report | {"code": ""} if self._has_keys and not is_guarded else report

    def _hear(self, data: bytes) -> None:
        """Take what the process says."""
        with contextlib.suppress(msgspec.DecodeError):
            said = self._decoder.decode(data)
            if said.line:
                self._notify(said.line)
            else:
                fields = msgspec.structs.asdict(said)
                self._report = {key: value for key, value in fields.items() if key != "line"}


def shown_host(host: str) -> str:
    """Return the host under which a headset reaches what is bound at `host`."""
    far_away = {"0.0.0.0": "192.0.2.1", "::": "2001:db8::1"}  # of no machine: RFC 5737, RFC 3849
    if host not in far_away:
        return host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:  # sends nothing
        try:
            probe.connect((far_away[host], 9))
            return str(probe.getsockname()[0])
        except OSError:  # no network
            return socket.gethostname()


def local_address(endpoint: str) -> str:
    """Return the address at which this machine reaches what is bound at `endpoint`."""
    address = parse_address(endpoint)
    everywhere = {"0.0.0.0": "127.0.0.1", "::": "::1"}
    return str(Address(everywhere.get(address.host, address.host), address.port))


def _run(pipe: Connection, listener: socket.socket, settings: Any) -> None:
    """Entry point of the process."""
    begin_process(_NICENESS, listener)
    from share.headset.server import HeadsetServer

    end_process(pipe, lambda: HeadsetServer(pipe, listener, settings).run(), (EOFError, BrokenPipeError))
