"""The pages that `share edge` serves: status page, live room and headset page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from share.errors import UsageError

if TYPE_CHECKING:
    from contextlib import ExitStack

    from share.cli.stderr import Stderr
    from share.headset.headset_page import HeadsetPage
    from share.headset.wearers import EdgeAccess
    from share.net.keys import EdgeKeys
    from share.net.transport import Address
    from share.runtime.edge import EdgeRun
    from share.runtime.edge_observer import EdgeObserver
    from share.runtime.room_plan import RoomPlan
    from share.view.viewer import LiveRoom
    from share.wire.room_messages import Permission


class PageOptions(NamedTuple):
    """The pages that the edge serves. views: addresses of live rooms, by room of a site; "": of an edge. out:
    folder for measurements of headset pages."""

    http: str | None
    views: Mapping[str, str]
    headset: str | None
    certificate: Path | None
    certificate_key: Path | None
    mounts: tuple[str, ...]
    token_file: Path | None
    out: Path | None

    def check(self, bind: str, is_streamed: bool) -> str | None:
        """Return the token of the status page and the live room. Raises UsageError, also if an option lacks
        another, one names no address, or two name the same."""
        from share.net.http_guard import read_token

        if self.headset is None and (self.certificate or self.certificate_key or self.mounts):
            raise UsageError("--headset-cert, --headset-key, --mount: they are for --headset; give it too")
        if self.headset is not None and is_streamed:
            raise UsageError(
                "--headset: policy streamed builds no map; leave it out, or choose another policy"
            )
        if self.token_file is not None and self.http is None and not self.views:
            raise UsageError("--http-token: it is for --http or --view; give one of them, or leave it out")
        token = None if self.token_file is None else read_token(self.token_file)
        named: dict[str, Address] = {}
        for option, address in self._addresses(bind, token).items():
            for other, taken in named.items():
                if address == taken and address.port:
                    text = f"{other} and {option} name the same port {address.port}; give each its own"
                    raise UsageError(text)
            named[option] = address
        return token

    def _addresses(self, bind: str, token: str | None) -> dict[str, Address]:
        from share.net.http_guard import http_address
        from share.net.transport import parse_address

        addresses = {"--bind": parse_address(bind, bind=True)}
        guarded = {"--http": self.http, **{view_option(room): text for room, text in self.views.items()}}
        for option, text in guarded.items():
            if text is not None:
                addresses[option] = http_address(option, text, token)
        if self.headset is not None:
            from share.headset.headset_page import page_address

            addresses["--headset"], _ = page_address(self.headset)
        return addresses


def view_option(room: str) -> str:
    """Return the option with which a live room is asked for, for messages. room: "" of an edge."""
    return f"--view {room}" if room else "--view"


def edge_access(endpoint: str, keys: EdgeKeys | None, allowed: frozenset[Permission]) -> EdgeAccess:
    """Return how the clients of wearers reach this edge; with keys, by ones that it lends them."""
    import secrets

    from share.headset.headset_page import local_address
    from share.headset.wearers import EdgeAccess
    from share.net.lent_keys import LentKeys

    address = local_address(endpoint)
    if keys is None:
        return EdgeAccess(address, allowed)
    secret = secrets.token_bytes(32)
    lent = LentKeys(secret)
    keys.allowed.public_key_of = lambda name: lent.pair(name).public
    return EdgeAccess(address, allowed, keys.allowed.path.parent, keys.own.public, secret)


class EdgePages:
    """The status page, the live room and the headset page of an edge, as far as they are asked for. run: set
    once it is made.

    access: of the clients of wearers; None: there is no headset page. rooms: of a site. Raises UsageError for
    what is malformed or missing, TransportError for a port in use."""

    def __init__(
        self,
        stack: ExitStack,
        stderr: Stderr,
        served: PageOptions,
        token: str | None,
        access: EdgeAccess | None,
        rooms: tuple[str, ...] = (),
    ) -> None:
        from share.runtime.room_plan import RoomPlan
        from share.runtime.status_server import StatusServer
        from share.view.viewer import LiveRoom

        self.run: EdgeRun | None = None
        self.observers: list[EdgeObserver] = []
        self._stack, self._token_file = stack, served.token_file
        self._stderr, self._addresses, self._is_guarded = stderr, list[str](), token is not None
        self._live_rooms: dict[str, LiveRoom] = {}  # by room; "" without rooms
        self._plans: dict[str, RoomPlan] = {}  # by room; "" without rooms
        self._headset: HeadsetPage | None = None
        if served.http is not None:
            status = StatusServer(served.http, self._report, stderr.print_line, token, self._plan)
            stack.callback(status.close)
            self._plans = {room: RoomPlan() for room in rooms or ("",)}
            self.observers += [] if rooms else self._plans.values()
            self._addresses.append(f"status at http://{status.endpoint}/")
        for room, address in served.views.items():
            title = f"SHARE {room}" if room else "SHARE edge"
            live_room = LiveRoom(address, token, title, stderr.print_line)
            stack.callback(live_room.close)
            self._live_rooms[room] = live_room
            self.observers += [] if room else [live_room.feed]
            of_room = f" of '{room}'" if room else ""
            self._addresses.append(f"live room{of_room} at http://{live_room.endpoint}/")
        if served.headset is not None and access is not None:
            self._add_headset(served.headset, access, served)

    def _add_headset(self, address: str, access: EdgeAccess, served: PageOptions) -> None:
        from share.headset.headset_page import HeadsetPage

        self._headset = page = HeadsetPage(
            address,
            access,
            certificate=served.certificate,
            key=served.certificate_key,
            mounts=served.mounts,
            out=served.out,
            notify=self._stderr.print_line,
        )
        self._stack.callback(page.close)
        self.observers.append(page.feed)
        self._addresses.append(f"headset page at {page.url}")
        if page.certificate is not None:
            self._addresses.append(f"its certificate has the SHA-256 {page.certificate.fingerprint}")

    def room_observers(self, room: str) -> list[EdgeObserver]:
        """Return the observers of one room of a site."""
        plan, live_room = self._plans.get(room), self._live_rooms.get(room)
        return [*([plan] if plan else []), *([live_room.feed] if live_room else [])]

    def _plan(self) -> dict[str, Any]:
        """Return /plan.json."""
        from share.site.report import site_plan

        reports = {room: plan.report() for room, plan in self._plans.items()}
        return reports[""] if "" in reports else site_plan(reports, self._report().get("agents", {}))

    def _report(self) -> dict[str, Any]:
        """Return the report of the edge, if it runs yet, with what its pages tell that live."""
        report: dict[str, Any] = {"loading": "starting"} if self.run is None else self.run.report()
        live_rooms = {room: one.endpoint for room, one in self._live_rooms.items() if one.is_alive}
        if (endpoint := live_rooms.get("")) is not None:
            report = report | {"live_room": endpoint}
        elif live_rooms and "rooms" in report:
            rooms = {
                room: one | ({"live_room": live_rooms[room]} if room in live_rooms else {})
                for room, one in report["rooms"].items()
            }
            report = report | {"rooms": rooms}
        if self._headset is not None and self._headset.is_alive:
            report = report | {"headset": self._headset.shown_report(self._is_guarded)}
        return report

    def print_addresses(self) -> None:
        token_file = self._token_file
        password = "" if token_file is None else f"  (any name; the password is in {token_file})"
        for one in self._addresses:
            is_guarded = one.startswith(("status", "live room"))
            self._stderr.print_line(one + password if is_guarded else one)
