"""Record the live room while two wearers and a robot play, as an animated WebP such as the one in README.

    share emulate --scene warehouse --motion ar1=walk: --motion ar2=walk:speed=1.2 --motion robot=robot: \\
        --profile d435i:640x480@15 --seconds 30 --seed 901 --out room
    python tools/record_live_room.py --session room --seconds 30 --out docs/pictures/live-room.webp

made that one; without --session it is the demo's. The session is played in virtual time
(`share.lab.evaluate.simulation`), so that a slow browser changes nothing: between two pictures the room
waits. A headless Chromium (`chromium` on the path, or CHROMIUM) draws the page. Needs the extras `emulate`
and `view`, and Pillow.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers.observed_simulation import observed_simulation  # noqa: E402
from PIL import Image  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from share.config import Config  # noqa: E402
from share.lab.emulate.recipe import demo_recipe, meeting_seed  # noqa: E402
from share.lab.emulate.session import make_cached_session  # noqa: E402
from share.recordings.session import Session, read_session  # noqa: E402
from share.view.viewer import LiveRoom  # noqa: E402

MAX_BYTES = 1_900_000
QUALITIES = (75, 65, 55, 45, 35, 25)  # the first whose file is small enough
_WITHOUT_NOTES = (  # what viser says of a browser without a graphics card
    "document.querySelectorAll('[class*=Notification-root]').forEach(note => note.remove())"
)
_POSES_SEEN_S, _SETTLE_S = 0.07, 0.35  # for the live room, which draws fifteen times a second; for the page


# A browser


class Page:
    """A page in a headless Chromium, driven by the DevTools protocol."""

    def __init__(self, connection: Any) -> None:
        self._connection, self._number = connection, 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(timeout=120))
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
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
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
                metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
                page.call("Emulation.setDeviceMetricsOverride", **metrics)
                page.call("Page.navigate", url=url)
                yield page
        finally:
            process.terminate()
            process.wait(30)


def _devtools_port(profile: Path) -> int:
    """Return the port that a browser with this profile listens on."""
    path = profile / "DevToolsActivePort"
    for _ in range(600):
        if path.is_file() and (text := path.read_text()):
            return int(text.split()[0])
        time.sleep(0.1)
    raise SystemExit("the browser did not start")


# The room


def pictures(session: Session, seconds: float, hz: float, width: int, height: int) -> list[bytes]:
    """Return pictures (PNG) of a session from its start to its end."""
    with closing(LiveRoom("0", None, "SHARE edge")) as live:
        room = observed_simulation(session, Config(), live.feed)
        with browser_page(f"http://{live.endpoint}/", width, height) as page:
            time.sleep(8.0)
            page.evaluate(_WITHOUT_NOTES)
            taken = list[bytes]()

            def take(t_s: float) -> None:
                time.sleep(_POSES_SEEN_S)
                if t_s >= (len(taken) + 1) / hz - 1e-6:
                    time.sleep(_SETTLE_S)
                    taken.append(page.picture())
                    print(f"{len(taken)} of {round(seconds * hz)} pictures", end="\r", file=sys.stderr)

            room.play(seconds, take)
    return taken


def animation(pngs: list[bytes], milliseconds: int, width: int) -> bytes:
    """Return an animated WebP so many pixels wide, of the best quality that is small enough."""
    frames = [Image.open(io.BytesIO(one)).convert("RGB") for one in pngs]
    size = width, round(frames[0].height * width / frames[0].width)
    frames = [one.resize(size, Image.Resampling.LANCZOS) for one in frames]
    data = b""
    for quality in QUALITIES:
        out = io.BytesIO()
        rest = {"append_images": frames[1:], "duration": milliseconds, "loop": 0}
        frames[0].save(out, "WEBP", save_all=True, quality=quality, method=4, **rest)
        data = out.getvalue()
        if len(data) <= MAX_BYTES:
            break
    return data


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--scene", default="warehouse")
    parser.add_argument("--session", type=Path, help="in place of the demo's: a folder by `share emulate`")
    parser.add_argument("--hz", type=float, default=2.0, help="pictures a second")
    parser.add_argument("--speed", type=float, default=1.0, help="how much faster it is shown")
    parser.add_argument("--size", default="1280x720", help="of the page")
    parser.add_argument("--width", type=int, default=960, help="of the animation")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--keep", type=Path, help="folder for the pictures themselves")
    given = parser.parse_args()
    recipe = demo_recipe(given.scene, given.seconds, meeting_seed(given.scene))
    folder = given.session or make_cached_session(recipe, progress=lambda stage, done, total: None)
    width, height = map(int, given.size.split("x"))
    pngs = pictures(read_session(folder.resolve()), given.seconds, given.hz, width, height)
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
        for k, one in enumerate(pngs, 1):
            (given.keep / f"{k:04}.png").write_bytes(one)
    data = animation(pngs, round(1000 / given.hz / given.speed), given.width)
    given.out.write_bytes(data)
    print(f"{given.out}: {len(pngs)} pictures, {len(data) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
