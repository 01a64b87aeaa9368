"""The server of the headset page: files over HTTP, and the room over WebSocket, in one event loop.

It takes events of the edge from a pipe, and tells what it shows there, so that it cannot hold the edge up.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import gc
import pickle
import socket
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response

from share.errors import ShareError
from share.headset import page_messages as page
from share.headset.certificate import PageCertificate, session_key
from share.headset.measures import MeasureTable, ServerReport, encode_report, measured_fields
from share.headset.mounts import ViewerMount
from share.headset.page_requests import FOLDER, PageAnswer, PageGuard, own_names, read_page
from share.headset.page_sending import CLOSE_S, end_page, has_left, refuse, send_all
from share.headset.pairing import PairingError
from share.headset.session_ledger import SessionLedger
from share.headset.shared_room import SharedRoom
from share.headset.wearer_session import SessionOverError
from share.headset.wearers import EdgeAccess, ListDamagedError, PageSeat, Wearer, WearerRegistry
from share.net.bounded_websocket import (
    BoundedListener,
    ModestSelector,
    PeerConnections,
    PeerLimits,
    serve_bounded,
)
from share.view.events import SessionBegun
from share.view.feed import END, batched
from share.view.page_process import HEARTBEAT

MAX_PAIRING, MAX_CONNECTIONS = 16, 100  # WebSockets that have not paired; connections before
# Of a page: files are asked for one by one; then it drags at 30 Hz, pings and measures.
_LIMITS = PeerLimits(MAX_PAIRING, MAX_CONNECTIONS, 200, 100.0, 2**18, 2**17)
SILENT_S = 6.0  # a page pings more often; one that does not has gone
_HELLO_S = 5.0
_REPORT_S, _PATH_S = 0.5, 1.0
_BACKLOG = 128  # connections that the kernel holds; more would wait for seconds
_UNSENT_BYTES = 2**16  # that wait in a page's connection before the newest is awaited
_SLEEP_RATIO = 1.0  # the loop uses at most half a core
_MAX_MOVES = 32  # of maps, that a page was told


@dataclass(frozen=True)
class HeadsetSettings:
    """What the server is started with. certificate: None: plain HTTP, of this machine alone. host: that it
    listens on. endpoint: the address and port to which sessions are bound. sessions: the folder with the key
    that signs them and what says which ones are the newest. began_s: when the page began, monotonic. table:
    where what pages measure is written. folder: with the page's files."""

    access: EdgeAccess
    host: str
    endpoint: str
    certificate: PageCertificate | None
    sessions: Path
    began_s: float
    mounts: dict[str, ViewerMount] = field(default_factory=dict)
    table: Path | None = None
    folder: Path = FOLDER


class HeadsetServer:
    """Serves until the pipe ends. Raises ShareError, OSError."""

    def __init__(self, pipe: Connection, listener: socket.socket, settings: HeadsetSettings) -> None:
        self._pipe, self._settings = pipe, settings
        certificate = settings.certificate
        self._tls = None if certificate is None else certificate.context()
        names = own_names(settings.host, () if certificate is None else certificate.names)
        self._guard = PageGuard("http" if certificate is None else "https", names, read_page(settings.folder))
        self._connections = PeerConnections(_LIMITS)
        self._listener = BoundedListener(listener, self._connections)
        self._room = SharedRoom()
        self._wearers = WearerRegistry(
            settings.access,
            session_key(settings.sessions),  # as it is now: whoever removes it has all pair anew
            SessionLedger(settings.endpoint, settings.sessions),
            self._notify,
            self._dismiss,
        )
        self._table = MeasureTable(settings.table)
        self._path_due_s, self._code_shown = 0.0, ""
        self._ended, self._tasks = asyncio.Event(), set[asyncio.Task[None]]()

    def run(self) -> None:
        gc.freeze()  # what stays is not looked at again and again
        loop = asyncio.SelectorEventLoop(ModestSelector(_SLEEP_RATIO))
        loop.set_exception_handler(lambda _loop, _context: None)  # anybody can cause failed handshakes
        loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        loop = asyncio.get_running_loop()
        server = await serve_bounded(
            self._serve_page,
            self._listener,
            self._tls,
            max_size=page.MAX_PAGE_BYTES,
            write_limit=_UNSENT_BYTES,
            close_timeout=CLOSE_S,
            process_request=self._answer,
        )
        self._listener.listen(_BACKLOG)
        threading.Thread(target=self._read_pipe, args=(loop,), name="feed", daemon=True).start()
        while not self._ended.is_set():
            self._report()
            self._wearers.remove_absent(time.monotonic())
            self._remove_unwanted()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_REPORT_S):
                    await self._ended.wait()
        self._wearers.close()
        server.close()

    def _remove_unwanted(self) -> None:
        """End pages whose session is over, or whose wearer has gone from the list of keys; one whose rights
        have changed comes back and is told so."""
        for wearer in self._wearers:
            if (seat := wearer.seat) is None:
                continue
            try:
                if self._wearers.rights_now(wearer) != seat.rights:
                    seat.connection.transport.abort()
            except ListDamagedError:
                continue  # the edge says so itself
            except PairingError as error:
                self._dismiss(wearer, seat, error)

    def _dismiss(self, wearer: Wearer, seat: PageSeat, error: PairingError) -> None:
        """End a page, and what its wearer's robots do."""
        self._tell(ServerReport(f"headset page: '{wearer.name}' has to go: {error}"))
        wearer.stop_robots()
        wearer.leave(seat)
        self._end_page(seat, str(error), isinstance(error, SessionOverError))

    def _end_page(self, seat: PageSeat, reason: str, is_over: bool) -> None:
        """Refuse a page by and by: one that is dead does not hold up another."""
        task = asyncio.create_task(end_page(seat, reason, is_over))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # ------------------------------------------------------------------ the edge

    def _read_pipe(self, loop: asyncio.AbstractEventLoop) -> None:
        """Apply the events of the edge, a message at a time, until it ends."""
        with contextlib.suppress(EOFError, OSError, RuntimeError):
            while (data := self._pipe.recv_bytes()) != END:
                waiting = []
                for event in pickle.loads(data):  # of our own parent process
                    waiting.append(event)
                    if isinstance(event, SessionBegun) and event.map_file is not None:
                        self._apply_now(loop, waiting)
                        self._load(loop, event.map_file)  # before what has come since
                        waiting = []
                self._apply_now(loop, waiting)
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(self._ended.set)

    def _apply_now(self, loop: asyncio.AbstractEventLoop, events: list[Any]) -> None:
        asyncio.run_coroutine_threadsafe(self._apply(events), loop).result()

    def _load(self, loop: asyncio.AbstractEventLoop, map_file: Path) -> None:
        from share.view.sources import map_file_events

        with contextlib.suppress(ShareError):  # the edge reports its own problems
            for events in batched(map_file_events(map_file)):
                self._apply_now(loop, events)

    async def _apply(self, events: list[Any]) -> None:
        for event in events:
            self._room.apply(event)
        seated = [(wearer, wearer.seat) for wearer in self._wearers if wearer.seat is not None]
        for move in self._room.take_moves():
            for wearer, seat in seated:
                _tell_move(wearer, seat, move)
        now_s = time.monotonic()
        has_paths = now_s >= self._path_due_s
        if has_paths:
            self._path_due_s = now_s + _PATH_S
        if poses := self._room.take_poses(has_paths):
            for _, seat in seated:
                seat.outbox.put_poses(poses)
                seat.wake.set()

    def _tell(self, report: ServerReport) -> None:
        self._pipe.send_bytes(encode_report(report))

    def _report(self) -> None:
        """Tell the edge that the server lives, and how it stands."""
        self._pipe.send_bytes(HEARTBEAT)
        desk, wearers = self._wearers.desk, list(self._wearers)
        about = {
            one.name: {
                "agent": one.session.agent,
                "is_connected": one.seat is not None,
                "is_connected_to_edge": one.is_connected_to_edge,
                **measured_fields(one.measured),
            }
            for one in wearers
        }
        pages = sum(one.seat is not None for one in wearers)
        self._tell(ServerReport("", desk.code, desk.wrong_count, pages, about))
        if desk.code != self._code_shown:
            self._code_shown = desk.code
            self._tell(ServerReport(f"headset page: the code for the next wearer is {desk.code}"))

    def _notify(self, line: str) -> None:
        self._tell(ServerReport(line))

    # ------------------------------------------------------------------ requests

    def _answer(self, connection: Any, request: Any) -> Response | None:
        headers: dict[str, str] = {}
        for name, value in request.headers.raw_items():
            headers.setdefault(name.lower(), value)
        answer = self._guard.answer(request.path, headers, "upgrade" in headers)
        if answer is None:
            if self._connections.admit(connection):
                return None
            text = f"{MAX_PAIRING} pages are pairing already\n".encode()
            answer = PageAnswer(503, "text/plain; charset=utf-8", text)  # type: ignore[arg-type]
        fields = Headers(self._guard.headers(headers.get("host", "")))
        fields["Content-Type"], fields["Content-Length"] = answer.media_type, str(len(answer.body))
        fields["Connection"] = "close"
        status = int(answer.status)
        return Response(status, "OK" if status == 200 else "Refused", fields, answer.body)

    # ------------------------------------------------------------------ pages

    async def _serve_page(self, connection: Any) -> None:
        """Let a page in as a wearer and serve it until either end closes."""
        try:
            wearer, secret, rights = await self._let_in(connection)
        except (TimeoutError, ConnectionClosed):
            connection.transport.abort()
            return
        except (PairingError, page.MessageError) as error:
            is_outdated = isinstance(error, page.OtherSchemaError)
            await refuse(connection, str(error), isinstance(error, SessionOverError), is_outdated)
            return
        self._connections.leave(connection)  # its place is its own from now on
        seat, taken_over = PageSeat(connection, rights), wearer.seat
        seat.reply(self._welcome(wearer, secret, rights))
        wearer.sit(seat)
        seat.outbox.put_poses(self._room.poses())
        sender = asyncio.create_task(send_all(seat))
        try:
            if taken_over is not None:
                self._end_page(taken_over, f"another page goes on as '{wearer.name}'", True)
            await self._read(wearer, seat)
        except page.MessageError as error:
            sender.cancel()
            await refuse(connection, str(error))
        except (TimeoutError, ConnectionClosed) as error:
            connection.transport.abort()
            if wearer.seat is seat and (isinstance(error, TimeoutError) or has_left(error)):
                wearer.stop_robots()
        finally:
            sender.cancel()
            wearer.leave(seat)

    async def _let_in(self, connection: Any) -> tuple[Wearer, str, frozenset[Any]]:
        """Raises PairingError, MessageError, TimeoutError, ConnectionClosed."""
        async with asyncio.timeout(_HELLO_S):
            data = await connection.recv()
        hello = page.decode_page(data)
        if not isinstance(hello, page.PageHello):
            raise page.MessageError("a page begins with hello")
        wearer, secret, rights = self._wearers.let_in(hello, connection.address)
        if hello.session is None:
            agent = wearer.session.agent
            what = "without a device" if agent is None else f"with the device of '{agent}'"
            self._tell(ServerReport(f"headset page: '{wearer.name}' has paired, {what}"))
            self._report()
        return wearer, secret, rights

    def _welcome(self, wearer: Wearer, secret: str, rights: frozenset[Any]) -> dict[str, Any]:
        mount = self._settings.mounts.get(wearer.session.agent or "")
        return {
            "type": "welcome",
            "schema": page.SCHEMA,
            "session": secret,
            "name": wearer.name,
            "agent": wearer.session.agent,
            "may": {"objects": "objects" in rights, "commands": "commands" in rights},
            "T_body_viewer": None if mount is None else mount.T_body_viewer,
            "mount_timeshift_ms": None if mount is None else mount.timeshift_ms,
            "agents": self._room.agents(),
        }

    async def _read(self, wearer: Wearer, seat: PageSeat) -> None:
        """Handle a page's messages. Raises MessageError, ConnectionClosed, TimeoutError."""
        while True:
            async with asyncio.timeout(SILENT_S):
                data = await seat.connection.recv()
            match page.decode_page(data):
                case page.PagePing(n, sent_ms):
                    t_ms = time.monotonic_ns() / 1e6
                    seat.reply({"type": "pong", "n": n, "sent_ms": sent_ms, "t_ms": t_ms})
                case page.PageSeen(n):
                    seat.outbox.mark_seen(n)
                    seat.wake.set()
                case page.PagePoints(map_id):
                    if seat.points_limit.take(time.monotonic_ns()):
                        self._send_points(seat, map_id)
                case page.PageMeasured() as measured:
                    self._take_measured(wearer, measured)
                case page.PageHello():
                    raise page.MessageError("a page says hello once")
                case wish:
                    self._ask(wearer, seat, wish)

    def _ask(self, wearer: Wearer, seat: PageSeat, wish: page.PageRequest | page.PageCommand) -> None:
        """Do what a page wants, if its wearer may still be here."""
        if wearer.seat is not seat:
            return  # another page has taken over, or its wearer had to go
        try:
            self._wearers.rights_now(wearer)
        except ListDamagedError:
            pass  # the edge answers
        except PairingError as error:
            wearer.refuse(wish, str(error))
            self._dismiss(wearer, seat, error)
            return
        wearer.ask(wish)

    def _send_points(self, seat: PageSeat, map_id: str) -> None:
        points = self._room.points(map_id)
        parts = [
            points[k : k + page.POINTS_PER_PART] for k in range(0, max(1, len(points)), page.POINTS_PER_PART)
        ]
        for k, part in enumerate(parts):
            data = base64.b64encode(part.astype("<f4").tobytes()).decode()
            about = {"map_id": map_id, "part": k, "parts": len(parts), "count": len(part)}
            seat.reply({"type": "points", **about, "data": data})

    def _take_measured(self, wearer: Wearer, measured: page.PageMeasured) -> None:
        wearer.measured = measured
        t_s, now_ns = time.monotonic() - self._settings.began_s, time.monotonic_ns()
        if line := self._table.add(t_s, wearer.name, wearer.session.agent, measured, now_ns):
            self._tell(ServerReport(line))


def _tell_move(wearer: Wearer, seat: PageSeat, move: Any) -> None:
    """Tell a page that its agent's map is another; of a wearer without an agent, what the first one does."""
    if wearer.session.agent is None:
        if (move.old, move.new) in wearer.has_moved:
            return
        wearer.has_moved[move.old, move.new] = None
        wearer.has_moved.pop((move.new, move.old), None)
        while len(wearer.has_moved) > _MAX_MOVES:
            del wearer.has_moved[next(iter(wearer.has_moved))]
    elif wearer.session.agent != move.agent:
        return
    T = move.T_new_old.ravel().tolist()
    seat.reply({"type": "map_changed", "old": move.old, "new": move.new, "T_new_old": T})
