"""What is sent to a page until it ends."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Any

from websockets.exceptions import ConnectionClosed

from share.headset import page_messages as page
from share.headset.wearers import PageSeat

CLOSE_S = 1.0
_SEND_S = 5.0


async def send_all(seat: PageSeat) -> None:
    """Send what there is as it comes; a page that does not read is disconnected."""
    try:
        while not seat.outbox.is_overfull:
            for message in seat.outbox.take(time.monotonic()):
                async with asyncio.timeout(_SEND_S):
                    await seat.connection.send(page.encode_page(message))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seat.outbox.wait_s(time.monotonic())):
                    await seat.wake.wait()
            seat.wake.clear()
    except ConnectionClosed:
        return
    except TimeoutError:
        pass
    seat.connection.transport.abort()


def has_left(error: ConnectionClosed) -> bool:
    """Return whether a page was closed, or another loaded in its place. A page that reconnects gives no
    code."""
    return error.rcvd is not None and error.rcvd.code in (1000, 1001)


async def end_page(seat: PageSeat, reason: str, is_over: bool) -> None:
    """Send a page the answers that wait, and end it."""
    for message in seat.outbox.take_replies():
        with contextlib.suppress(TimeoutError, ConnectionClosed):
            async with asyncio.timeout(CLOSE_S):
                await seat.connection.send(page.encode_page(message))
    await refuse(seat.connection, reason, is_over)


async def refuse(connection: Any, reason: str, is_over: bool = False, is_outdated: bool = False) -> None:
    """Say why a page is not served, and close. is_over: it shall forget its session; is_outdated: load itself
    again."""
    about = {"reason": reason, "is_over": is_over, "is_outdated": is_outdated}
    with contextlib.suppress(TimeoutError, ConnectionClosed):
        async with asyncio.timeout(CLOSE_S):
            await connection.send(page.encode_page({"type": "refused", **about}))
            await connection.close(1008)
    connection.transport.abort()
