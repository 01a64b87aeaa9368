"""Record the live room of a demo as an animated WebP, such as the one in README.

    python tools/record_live_room.py --seconds 60 --out docs/pictures/live-room.webp

Runs `share demo`, opens its page in a headless Chromium (`chromium` on the path, or CHROMIUM) and takes a
picture of it twice a second. It needs the extras `view` and `websocket` and Pillow.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image
from websockets.sync.client import connect

MAX_BYTES = 1_900_000
QUALITIES = (70, 60, 50, 40, 30, 20)  # the first whose file is small enough


class Page:
    """A page in a headless Chromium, driven by the DevTools protocol."""

    def __init__(self, connection: Any) -> None:
        self._connection, self._number = connection, 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(timeout=60))
            if answer.get("id") == self._number:
                return dict(answer.get("result", {}))

    def evaluate(self, script: str) -> Any:
        return self.call("Runtime.evaluate", expression=script)["result"].get("value")

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            button = "none" if kind == "mouseMoved" else "left"
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=1)

    def picture(self) -> bytes:
        """Return what it shows as a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


@contextmanager
def browser_page(url: str, width: int, height: int) -> Iterator[Page]:
    """Open a URL in a browser of its own."""
    program = os.environ.get("CHROMIUM", "chromium")
    with tempfile.TemporaryDirectory() as profile:
        command = [
            *(program, "--headless=new", "--no-sandbox", "--hide-scrollbars"),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-port=0"),
            *(f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"),
        ]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = _devtools_port(Path(profile))
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as listing:
                target = next(one for one in json.load(listing) if one["type"] == "page")
            with connect(target["webSocketDebuggerUrl"], max_size=None) as connection:
                page = Page(connection)
                page.call(
                    "Emulation.setDeviceMetricsOverride",
                    **{"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600},
                )
                page.call("Page.navigate", url=url)
                yield page
        finally:
            process.terminate()
            process.wait(10)


def _devtools_port(profile: Path) -> int:
    """Return the port that a browser with this profile listens on."""
    for _ in range(200):
        path = profile / "DevToolsActivePort"
        if path.is_file() and (text := path.read_text()):
            return int(text.split()[0])
        time.sleep(0.1)
    raise SystemExit("the browser did not start")


@contextmanager
def running_demo(seconds: float, more: list[str]) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the demo; yield it, and the address of its live room."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "share", "demo", "--seconds", str(seconds), "--out", out, *more]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            lines = (re.search(r"live room at (http://\S+)", line) for line in process.stderr)
            address = next((found[1] for found in lines if found), None)
            if address is None:
                raise SystemExit("the demo has not said where its live room is; is viser installed?")
            yield process, address
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(60)


def record(seconds: float, hz: float, width: int, height: int, more: list[str]) -> list[bytes]:
    """Return pictures (PNG) of a demo from its start to its end."""
    pictures = []
    with running_demo(seconds, more) as (demo, address), browser_page(address, width, height) as page:
        start_s = time.monotonic()
        while demo.poll() is None and time.monotonic() - start_s < seconds + 15:
            due_s = start_s + len(pictures) / hz
            time.sleep(max(0.0, due_s - time.monotonic()))
            pictures.append(page.picture())
    return pictures


def animation(pictures: list[bytes], milliseconds: int) -> bytes:
    """Return an animated WebP, of the best quality that is small enough."""
    frames = [Image.open(io.BytesIO(one)).convert("RGB") for one in pictures]
    data = b""
    for quality in QUALITIES:
        out = io.BytesIO()
        frames[0].save(
            out,
            "WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=milliseconds,
            loop=0,
            quality=quality,
            method=4,
        )
        data = out.getvalue()
        if len(data) <= MAX_BYTES:
            break
    return data


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument("--speed", type=float, default=2.0, help="How much faster it is shown.")
    parser.add_argument("--size", default="960x600")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--keep", type=Path, help="Folder for the pictures themselves.")
    given, more = parser.parse_known_args()
    width, height = map(int, given.size.split("x"))
    pictures = record(given.seconds, given.hz, width, height, more)
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
        for k, one in enumerate(pictures):
            (given.keep / f"{k:04}.png").write_bytes(one)
    data = animation(pictures, round(1000 / given.hz / given.speed))
    given.out.write_bytes(data)
    print(f"{given.out}: {len(pictures)} pictures, {len(data) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
