"""Pages in a headless Chromium, driven by the DevTools protocol, and headsets that `iwer` emulates in them.

`iwer` (MIT, an emulator of WebXR devices) is fetched by npm into a cache folder, once; it is not part of the
repository. Tests skip, with a reason, where Chromium or it is missing.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tarfile
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

IWER = "iwer@2.5.0"
_CALL_S = 300.0  # on a busy machine
_HEAP = {"code": "code", "object shape": "code", "native": "native"}  # what is no data of a page's scripts

# A Quest 3 whose head, hands and recentering a test moves: `headset` is its device.
_EMULATED = """
(() => {
    const device = new IWER.XRDevice(IWER.metaQuest3);
    device.installRuntime({ forceInstall: true });
    device.stereoEnabled = true;
    device.position.set(0, 1.6, 0);
    window.headset = device;
    window.move = null;  // moves it, just before each frame
    let movedMs = 0;
    const step = () => {
        requestAnimationFrame(step);
        movedMs = performance.now();
        window.move?.(performance.timeOrigin + movedMs);
    };
    requestAnimationFrame(step);
    // Frames are of when it was moved: on a busy machine tens of milliseconds may pass until one begins.
    Object.defineProperty(XRFrame.prototype, "predictedDisplayTime", { get: () => movedMs });
})();
"""

# At most so many frames a second are drawn: by software each costs what agents beside need.
_SLOWER = """
(() => {
    const draw = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (then) => setTimeout(() => draw(then), MS);
})();
"""

# The middle of an element; null as long as it is not there, disabled, hidden or covered.
_PUSHABLE = """(selector) => {
    const one = document.querySelector(selector);
    if (!one || one.disabled) return null;
    one.scrollIntoView({ block: "center" });
    const box = one.getBoundingClientRect();
    const at = [box.x + box.width / 2, box.y + box.height / 2];
    return document.elementFromPoint(...at) === one ? at : null;
}"""


class BrowserError(Exception):
    """A script of the page failed."""


class BrowserPage:
    """A tab. `problems`: what its scripts said of errors, and what its content policy refused."""

    def __init__(self, endpoint: str) -> None:
        self._connection, self._number = _connect(endpoint), 0
        self.problems = list[str]()
        self._traced, self._is_traced = list[dict[str, Any]](), False
        self._snapshot = list[str]()
        for domain in ("Runtime", "Page", "Log"):
            self.call(f"{domain}.enable")

    def close(self) -> None:
        with suppress(ConnectionClosed):
            self._connection.send(json.dumps({"id": 0, "method": "Page.close"}))
        self._connection.close()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(timeout=_CALL_S))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return dict(answer["result"])
            self._note(answer)

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression, which may be a promise. Raises BrowserError."""
        done = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True, userGesture=True
        )
        if "exceptionDetails" in done:
            raise BrowserError(done["exceptionDetails"].get("exception", {}).get("description", str(done)))
        return done["result"].get("value")

    def app(self, expression: str) -> Any:
        """Return the value of an expression of `app`, the page's state."""
        return self.evaluate(f'import("/main.js").then(({{ app }}) => {{ return ({expression}); }})')

    def wait(self, expression: str, seconds: float = 300.0) -> Any:
        """Return the value of an expression of `app` once it is true."""
        end = time.monotonic() + seconds
        while not (value := self.app(expression)):
            assert time.monotonic() < end, f"{expression} is still {value!r}; {self.problems}"
            time.sleep(0.03)
        return value

    def wait_for(self, expression: str, seconds: float = 60.0) -> None:
        """Wait until an expression is true in a page whose module may not be there, and which may load."""
        end, found = time.monotonic() + seconds, None
        while found is not True:
            assert time.monotonic() < end, f"{expression}: {found}; {self.problems}"
            with suppress(BrowserError, AssertionError):
                found = self.evaluate(expression)
            time.sleep(0.03)

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        end = time.monotonic() + _CALL_S
        while self.evaluate("location.href.slice(0, 4) + document.readyState") != "httpcomplete":
            assert time.monotonic() < end
            time.sleep(0.03)

    def resize(self, width: int, height: int, scale: float = 1.0) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": scale}
        self.call("Emulation.setDeviceMetricsOverride", **size, mobile=width < height)

    def click(self, selector: str) -> None:
        """Push an element in its middle, once it can be pushed there."""
        end = time.monotonic() + _CALL_S
        while (at := self.evaluate(f"({_PUSHABLE})({selector!r})")) is None:
            assert time.monotonic() < end, f"{selector} cannot be pushed; {self.problems}"
            time.sleep(0.03)
        self.mouse("mousePressed", *at)
        self.mouse("mouseReleased", *at)

    def mouse(self, kind: str, x: float, y: float) -> None:
        button = "none" if kind == "mouseMoved" else "left"
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=1, clickCount=1)

    def type(self, selector: str, text: str) -> None:
        self.evaluate(f"document.querySelector({selector!r}).focus()")
        self.call("Input.insertText", text=text)

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def begin_trace(self, *categories: str) -> None:
        """Note events of all pages of the browser, with the CPU time of their threads."""
        included = {"includedCategories": list(categories), "excludedCategories": ["*"]}
        self.call("Tracing.start", traceConfig=included, transferMode="ReportEvents")

    def end_trace(self) -> list[dict[str, Any]]:
        self._traced, self._is_traced = [], False
        self.call("Tracing.end")
        while not self._is_traced:
            self._note(json.loads(self._connection.recv(timeout=_CALL_S)))
        return self._traced

    def heap_bytes(self) -> dict[str, int]:
        """Return what lies on the heap of its scripts after collection: `data` (objects, arrays, texts,
        numbers, closures), `code` (compiled, with shapes of objects), `native` (of the browser itself)."""
        self._snapshot = []
        for _ in range(2):
            self.call("HeapProfiler.collectGarbage")
        self.call("HeapProfiler.takeHeapSnapshot", reportProgress=False)
        snapshot = json.loads("".join(self._snapshot))
        about, nodes = snapshot["snapshot"]["meta"], snapshot["nodes"]
        fields, kinds = about["node_fields"], about["node_types"][0]
        types = nodes[fields.index("type") :: len(fields)]
        sizes = nodes[fields.index("self_size") :: len(fields)]
        found = {"data": 0, "code": 0, "native": 0}
        for kind, size in zip(types, sizes, strict=True):
            found[_HEAP.get(kinds[kind], "data")] += size
        return found

    def _note(self, event: dict[str, Any]) -> None:
        match event.get("method"):
            case "HeapProfiler.addHeapSnapshotChunk":
                self._snapshot.append(event["params"]["chunk"])
            case "Tracing.dataCollected":
                self._traced += event["params"]["value"]
            case "Tracing.tracingComplete":
                self._is_traced = True
            case "Runtime.exceptionThrown":
                details = event["params"]["exceptionDetails"]
                self.problems.append(details.get("exception", {}).get("description", details["text"]))
            case "Log.entryAdded" if event["params"]["entry"]["level"] == "error":
                entry = event["params"]["entry"]
                if "favicon" not in entry.get("url", ""):
                    self.problems.append(f"{entry['text']} {entry.get('url', '')}")
            case "Runtime.consoleAPICalled" if event["params"]["type"] == "error":
                self.problems.append(str(event["params"]["args"]))


class Browser:
    def __init__(self, port: int) -> None:
        self._port, self.pages = port, list[BrowserPage]()

    def close_pages(self) -> None:
        """Pages that are open draw."""
        while self.pages:
            self.pages.pop().close()

    def page(
        self,
        url: str,
        width: int = 960,
        height: int = 540,
        emulator: Path | None = None,
        max_hz: float | None = None,
    ) -> BrowserPage:
        """Open a URL in a window of its own. emulator: that makes it a headset's browser. max_hz: frames
        that it draws; None: as many as it can."""
        listing = f"http://127.0.0.1:{self._port}/json/version"
        with urllib.request.urlopen(listing) as answer:
            whole = _connect(json.load(answer)["webSocketDebuggerUrl"])
        with whole:
            order = {"url": "about:blank", "newWindow": True, "width": width, "height": height}
            whole.send(json.dumps({"id": 1, "method": "Target.createTarget", "params": order}))
            target = json.loads(whole.recv(timeout=_CALL_S))["result"]["targetId"]
        page = BrowserPage(f"ws://127.0.0.1:{self._port}/devtools/page/{target}")
        self.pages.append(page)
        page.resize(width, height)
        if max_hz is not None:
            slower = _SLOWER.replace("MS", f"{1e3 / max_hz - 1e3 / 60:.1f}")
            page.call("Page.addScriptToEvaluateOnNewDocument", source=slower)
        if emulator is not None:
            page.call("Page.addScriptToEvaluateOnNewDocument", source=emulator.read_text() + _EMULATED)
        page.open(url)
        return page


@contextmanager
def browser() -> Iterator[Browser]:
    """Start a browser of its own."""
    program = shutil.which(os.environ.get("CHROMIUM", "chromium"))
    if program is None:
        pytest.skip("chromium is not installed: the page is not run")
    with ExitStack() as cleanup:
        profile = Path(cleanup.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        command = [
            *(program, "--headless=new", "--no-sandbox", "--hide-scrollbars", "--no-first-run"),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-port=0"),
            *("--disable-renderer-backgrounding", "--disable-backgrounding-occluded-windows"),
            *(
                "--disable-background-timer-throttling",
                "--enable-precise-memory-info",
                "--js-flags=--expose-gc",
            ),
            *(f"--user-data-dir={profile}", "about:blank"),
        ]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        cleanup.callback(process.wait, 30)
        cleanup.callback(process.terminate)
        one = Browser(_devtools_port(profile))
        cleanup.callback(one.close_pages)
        yield one


def _connect(endpoint: str) -> ClientConnection:
    return connect(endpoint, max_size=None, ping_interval=None, open_timeout=_CALL_S)


def _devtools_port(profile: Path) -> int:
    path = profile / "DevToolsActivePort"
    for _ in range(300):
        if path.is_file() and (text := path.read_text()):
            return int(text.split()[0])
        time.sleep(0.1)
    raise AssertionError("the browser did not start")


def emulator() -> Path:
    """Return the script of `iwer`, from the cache or by npm; skip without it."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "share-slam" / "iwer-2.5.0"
    script = cache / "iwer.min.js"
    if script.is_file():
        return script
    if (npm := shutil.which("npm")) is None:
        pytest.skip(f"{IWER} is not in {cache} and npm is not installed: no headset is emulated")
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run([npm, "pack", IWER], cwd=folder, capture_output=True, text=True, timeout=120)
        packed = list(Path(folder).glob("*.tgz"))
        if done.returncode != 0 or not packed:
            pytest.skip(f"npm did not fetch {IWER}: no headset is emulated: {done.stderr[-200:]}")
        with tarfile.open(packed[0]) as archive:
            data = archive.extractfile("package/build/iwer.min.js")
            assert data is not None
            cache.mkdir(parents=True, exist_ok=True)
            new = cache / f"new-{os.getpid()}"
            new.write_bytes(data.read())
            new.rename(script)
    return script
