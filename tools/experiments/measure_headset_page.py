"""The headset page in figures: emulated headsets in Chromium, and a wearer's motion without one. Prints JSON.

    python tools/experiments/measure_headset_page.py marker [--link wifi5] [--seconds 30] [--seed 1]
    python tools/experiments/measure_headset_page.py script [--seconds 30]
    python tools/experiments/measure_headset_page.py memory [--seconds 180]
    python tools/experiments/measure_headset_page.py goal [--count 20]
    python tools/experiments/measure_headset_page.py align [--seeds 500:540]
    python tools/experiments/measure_headset_page.py follow --truth FOLDER/groundtruth.csv [--seeds 500:505]

marker: two wearers, emulated Quest 3s of 320 x 160 px (drawn in software), walk about; one drags a marker
along the floor. For each place that both drew: by how much later the other drew it, by the wall clock, from
frame to frame. Also the times of frames, what a frame takes in script, and from a pose's stamp to its
frame.
script: what a page takes in script a frame, by the CPU time of its thread, with two pages that drag a marker.
memory: what lies on the heap of a page's scripts, after collection, while its wearer walks and drags a
marker: its data, compiled code, what the browser itself has.
goal: the trigger pulled on "Go there" -> the page hears that a robot's action server has accepted, so the
way back is in it. Needs SHARE_ROS, an environment with rclpy (CONTRIBUTING.md).
All four: the edge's own page server, the edge's protocol on a real link without mapper and agents; --link:
between each page and the server.
align, follow: `headset_motion.py`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

import numpy as np  # noqa: E402
from headset_motion import measure_alignment, measure_follow  # noqa: E402
from helpers import emulated_wearer as worn  # noqa: E402
from helpers.browser import Browser, BrowserPage, browser  # noqa: E402
from helpers.delayed_port import DelayedPort  # noqa: E402
from helpers.script_time import mark_frames, script_cpu_ms  # noqa: E402
from helpers.served_room import ServedRoom, served_room  # noqa: E402
from make_keyframe_sets import seeds_of  # noqa: E402
from scipy.stats import linregress  # noqa: E402
from scipy.stats import t as student_t  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.errors import UsageError  # noqa: E402
from share.lab.evaluate.emulated_network import load_network  # noqa: E402
from share.lab.evaluate.provenance import describe_machine  # noqa: E402

_SIZE = (320, 160)
_DRAG_S = 3.0
_HEAP_EVERY_S = 15.0
_SETTLED_MIN = 2.0

Figures = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    measures: dict[str, Callable[[argparse.Namespace], Figures]] = {
        "marker": marker,
        "script": script,
        "memory": memory,
        "goal": goal,
        "align": lambda options: measure_alignment(options.seeds),
        "follow": lambda options: measure_follow(options.truth, options.seeds),
    }

    def work() -> None:
        began = os.getloadavg()[0]
        figures = measures[options.what](options)
        about = {
            "what": options.what,
            "machine": describe_machine(),
            "load": [round(began, 1), os.getloadavg()[0]],
        }
        print(json.dumps(about | figures, indent=1))

    return exit_code("measure_headset_page", work)


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    made.add_argument("what", choices=("marker", "script", "memory", "goal", "align", "follow"))
    made.add_argument("--link", metavar="NAME", help="an emulated network, such as wifi5")
    made.add_argument("--seconds", type=float, default=30.0)
    made.add_argument("--seed", type=int, default=1, help="of the emulated network")
    made.add_argument("--seeds", type=seeds_of, default=range(500, 540), metavar="FIRST:END")
    made.add_argument("--truth", type=Path, metavar="FILE", help="EuRoC's groundtruth.csv of a motion")
    made.add_argument("--count", type=int, default=20, help="of goals")
    return made


# ---------------------------------------------------------------- in Chromium


def marker(options: argparse.Namespace) -> Figures:
    with _wearers(options, ("ann", "ben")) as (_, (ann, ben)):
        for page in (ann, ben):
            page.app(worn.SEEN)
            page.app("(times = { script: [], latency: [] }, 0)")
            page.app(
                "(['script', 'latency'].forEach((name) => { const one = app[name], add = one.add;"
                " one.add = (ms) => { times[name].push(ms); add.call(one, ms); }; }), 0)"
            )
        for _ in range(max(1, round(options.seconds / _DRAG_S))):
            worn.drag_marker(ann, _DRAG_S)
            ann.app("(app.connection.remove([...app.room.objects.keys()][0]), 0)")
            ben.wait("app.room.objects.size === 0", 20)
        late = worn.lateness_ms(ann, ben)
        return {
            "link": options.link or "loopback",
            "drawn_by_the_other_ms": _spread(late),
            "pages": {
                name: {
                    "frame_ms": _spread(np.diff(page.evaluate("frameTimes"))),
                    "script_ms": _spread(page.evaluate("times.script")),
                    "pose_to_frame_ms": _spread(page.evaluate("times.latency")),
                }
                for name, page in (("ann", ann), ("ben", ben))
            },
            "problems": ann.problems + ben.problems,
        }


def script(options: argparse.Namespace) -> Figures:
    figures: Figures = {"pages": {}}
    with _wearers(options, ("ann", "ben")) as (_, (ann, ben)):
        for name, page in (("ann", ann), ("ben", ben)):
            mark_frames(page)
            began = time.monotonic()
            frames, others = script_cpu_ms(page, lambda: worn.drag_marker(ann, options.seconds / 2))
            figures["pages"][name] = {
                "frames_per_s": round(len(frames) / (time.monotonic() - began), 1),
                "cpu_ms_of_a_frame": _spread(frames),
                "share_over_2_ms": round(float(np.mean(np.array(frames) > 2)), 4),
                "cpu_ms_of_all_script_by_frames": round((sum(frames) + sum(others)) / len(frames), 3),
            }
            ann.app("(app.connection.remove([...app.room.objects.keys()][0]), 0)")
            ann.wait("app.room.objects.size === 0", 20)
    return figures


def memory(options: argparse.Namespace) -> Figures:
    with _wearers(options, ("ann",)) as (_, (ann,)):
        worn.push(ann, "marker")
        worn.place(ann, "marker")
        ann.evaluate(
            "(drags = (ms) => { const s = Math.sin(ms / 1000);"
            " aims = { ...aims, at: [0.6 - s, 0, -1.4 - 0.5 * s] }; }, 0)"
        )
        frames, began, heap = ann.app("app.frames"), time.monotonic(), list[tuple[float, dict[str, int]]]()
        while (now := time.monotonic()) - began < options.seconds:
            time.sleep(_HEAP_EVERY_S)
            heap.append(((now - began + _HEAP_EVERY_S) / 60, ann.heap_bytes()))
        later = [one for one in heap if one[0] >= _SETTLED_MIN]
        return {
            "seconds": options.seconds,
            "frames": ann.app("app.frames") - frames,
            "minutes": [round(minute, 2) for minute, _ in heap],
            "heap_kb": {kind: [round(some[kind] / 1e3, 1) for _, some in heap] for kind in heap[0][1]},
            "growth_kb_per_minute_from_2": {
                kind: _growth([minute for minute, _ in later], [some[kind] / 1e3 for _, some in later])
                for kind in heap[0][1]
            },
        }


def _growth(minutes: Sequence[float], values: Sequence[float]) -> Figures:
    """Slope of a line with its interval of 95 %, as of errors that do not last."""
    x, y = np.asarray(minutes), np.asarray(values)
    if len(x) < 3:
        return {"n": len(x)}
    line = linregress(x, y)
    half = line.stderr * student_t.ppf(0.975, len(x) - 2)
    return {"n": len(x), "slope": round(line.slope, 3), "half_interval": round(half, 3)}


def goal(options: argparse.Namespace) -> Figures:
    from helpers.ros_bench import ROS, RosRoom, built_messages

    if ROS is None:
        raise UsageError("goal: SHARE_ROS names no environment with rclpy (CONTRIBUTING.md)")
    took_ms = []
    with _wearers(options, ("ann",)) as (served, (ann,)), tempfile.TemporaryDirectory() as folder:
        domain = 40 + os.getpid() % 60
        robot = RosRoom(built_messages("jazzy"), domain, Path(folder), drive_s=60.0, edge=served.edge.address)
        ended = threading.Event()
        drives = threading.Thread(target=robot.run, args=(1e6, ended.is_set))
        drives.start()
        try:
            _until(robot.is_ready, f"the robot is not ready: {robot.printed}")
            worn.stand(ann)
            served.walk.walks = False
            worn.drag_marker(ann, _DRAG_S)
            for _ in range(options.count):
                worn.aim(ann, "there")
                ann.evaluate(_PULL)
                _until(lambda: ann.evaluate("acceptedMs"), "no goal was accepted")
                took_ms.append(ann.evaluate("acceptedMs"))
                worn.press(ann, False)
                _until(lambda: "to go" in ann.app("app.room.words('bot')"), "it does not drive")
                worn.push(ann, "stop")
                _until(lambda: ann.app("app.room.commands.get('bot').is_final"), "it goes on")
                time.sleep(0.5)
        finally:
            ended.set()
            drives.join()
            robot.close()
    return {"goals": len(took_ms), "trigger_to_accepted_as_the_page_hears_ms": _spread(took_ms)}


# Pulls the trigger, and notes when the page hears that the robot's server has accepted.
_PULL = """(async () => {
    const { app } = await import("/main.js");
    const [before, pulledMs] = [app.room.commands.get("bot"), performance.now()];
    acceptedMs = 0;
    const watched = setInterval(() => {
        const one = app.room.commands.get("bot");
        if (one === before || one.is_final || !/^(accepted|executing|.* to go)/.test(one.text)) return;
        acceptedMs = performance.now() - pulledMs;
        clearInterval(watched);
    }, 1);
    headset.controllers.right.updateButtonValue("trigger", 1);
})()"""


def _until(is_true: Callable[[], object], otherwise: str) -> None:
    end = time.monotonic() + 30.0
    while not is_true():
        if time.monotonic() > end:
            raise UsageError(f"goal: {otherwise} after 30 s")
        time.sleep(0.02)


@contextmanager
def _wearers(
    options: argparse.Namespace, names: Sequence[str]
) -> Iterator[tuple[ServedRoom, list[BrowserPage]]]:
    """Wearers in emulated headsets, who walk about and know where they are."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CONFIG_HOME"] = folder
        cache = Path.home() / ".cache"
        os.environ.setdefault("XDG_CACHE_HOME", str(cache))
        with served_room(Path(folder), names) as served, browser() as chromium:
            url, port = served.url, None
            if options.link is not None:
                host, _, number = served.page.endpoint.rpartition(":")
                port = DelayedPort((host, int(number)), load_network(options.link), options.seed)
                url = f"http://127.0.0.1:{port.port}/"
            pages = [_wear(chromium, served, url, name) for name in names]
            time.sleep(5.0)
            yield served, pages
            if port is not None:
                port.close()


def _wear(chromium: Browser, served: ServedRoom, url: str, name: str) -> BrowserPage:
    page = worn.wear(chromium, url, name, served.next_code(), _SIZE)
    page.evaluate("walks = true")
    page.wait("app.place.mapId !== null && app.alignmentMm !== null")
    return page


def _spread(values: Sequence[float] | np.ndarray) -> Figures:
    some = np.asarray(values, float)
    if not len(some):
        return {"n": 0}
    p50, p95, p99 = np.percentile(some, [50, 95, 99]).round(2).tolist()
    return {"n": len(some), "median": p50, "p95": p95, "p99": p99}


if __name__ == "__main__":
    sys.exit(main())
