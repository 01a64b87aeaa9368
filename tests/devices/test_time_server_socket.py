"""A time server goes on whatever its socket does."""

from __future__ import annotations

import threading
import time
from typing import Any

from share.devices.time_server import TimeServer, TimeServerRun
from share.net.ntp import NtpMode, NtpPacket, from_stamp
from share.net.udp import Datagram

NOW = 1_795_446_605 * 10**9
QUESTION = NtpPacket(NtpMode.CLIENT, transmit=5).encode()


class Script:
    """In place of a socket: what `receive` does, one after the other, and then `over`."""

    def __init__(self, *steps: Datagram | OSError, over: threading.Event) -> None:
        self._steps, self._over = list(steps), over
        self.sent: list[tuple[bytes, Any]] = []

    def receive(self, timeout_s: float) -> Datagram | None:
        if not self._steps:
            self._over.set()
            return None
        step = self._steps.pop(0)
        if isinstance(step, OSError):
            raise step
        return step

    def send(self, data: bytes, to: Any = None) -> None:
        if to[1] == 0:
            raise OSError(22, "Invalid argument")
        self.sent.append((data, to))


def serve(*steps: Datagram | OSError) -> tuple[list[tuple[bytes, Any]], list[str]]:
    """What is sent and said."""
    over, said = threading.Event(), []
    link = Script(*steps, over=over)
    run = TimeServerRun(link, TimeServer(), said.append)  # type: ignore[arg-type]
    thread = threading.Thread(target=run.run)
    thread.start()
    assert over.wait(10)
    run.stop()
    thread.join(10)
    assert not thread.is_alive()
    return link.sent, said


def question(address: str, port: int) -> Datagram:
    return Datagram(QUESTION, (address, port), NOW)


def test_an_unreachable_client_is_reported_once_and_delays_no_other() -> None:
    forged = [question("192.0.2.9", 0)] * 5
    sent, said = serve(*forged, question("192.0.2.1", 4000), *forged, question("192.0.2.2", 4000))
    assert [to for _, to in sent] == [("192.0.2.1", 4000), ("192.0.2.2", 4000)]
    assert said == [
        "cannot send a reply to 192.0.2.9: Invalid argument",
        "new client: 192.0.2.9",
        "new client: 192.0.2.1",
        "new client: 192.0.2.2",
    ]


def test_a_socket_that_fails_for_a_while_is_retried() -> None:
    failing = [OSError(105, "No buffer space available")] * 2
    sent, said = serve(*failing, question("192.0.2.1", 4000))
    assert len(sent) == 1
    assert said == ["cannot receive: No buffer space available", "new client: 192.0.2.1"]


def test_a_reply_carries_its_transmit_time() -> None:
    before = time.time_ns()
    sent, _ = serve(question("192.0.2.1", 4000))
    answer = NtpPacket.decode(sent[0][0])
    assert from_stamp(answer.receive, NOW) == NOW
    assert before <= from_stamp(answer.transmit, before) <= time.time_ns()
