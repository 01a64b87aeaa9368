"""What a page takes in script, by the CPU time of its thread as the browser traces it.

Waits, as for WebGL that is drawn in software, and other processes are not in it; calls of WebGL are.
"""

from __future__ import annotations

from collections.abc import Callable

from helpers.browser import BrowserPage

# Says when the page's own part of a frame in the headset begins and ends; the emulator's is not in it.
_MARKED = """(() => {
    const { session } = app;
    const request = session.requestAnimationFrame.bind(session);
    session.requestAnimationFrame = (draw) => request((...frame) => {
        console.timeStamp("begins");
        draw(...frame);
        console.timeStamp("ends");
    });
})()"""


def mark_frames(page: BrowserPage) -> None:
    """Until it leaves the headset; once."""
    page.app(_MARKED)


def script_cpu_ms(page: BrowserPage, work: Callable[[], None]) -> tuple[list[float], list[float]]:
    """Return what each marked frame takes while some work is done, ms, and what else the page's script does:
    each message and timer."""
    page.begin_trace("devtools.timeline")
    work()
    events = page.end_trace()
    began_us: float | None = None
    frames, others = list[float](), list[float]()
    for event in sorted(events, key=lambda one: float(one["ts"])):
        data = event.get("args", {}).get("data", {})
        match event["name"], data.get("message"):
            case "TimeStamp", "begins":
                began_us = event["tts"]
            case "TimeStamp", "ends" if began_us is not None:
                frames.append((event["tts"] - began_us) / 1e3)
            case "FunctionCall", _ if data.get("url", "").endswith("/main.js"):
                others.append(event["tdur"] / 1e3)
    return frames, others
