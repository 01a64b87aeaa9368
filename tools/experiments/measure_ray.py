"""What a mapper that is reached through Ray costs against one that is a child process.

    python tools/experiments/measure_ray.py [--keyframes 400] [--folder DIR]

A Ray cluster is started on this machine. Keyframes of 800 features and a JPEG of 17 kB go by turns to either
mapper, and each is timed from `send` to the answer that it was added. Then changes with such a keyframe each
are written by turns to a map file here and to one that a worker has open. Prints a JSON object: ms.
"""

from __future__ import annotations

import argparse
import json
import queue
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

from share.config import Config  # noqa: E402
from share.geometry.camera import Camera, ImuNoise, Rig  # noqa: E402
from share.mapping.map_changes import SaveKeyframe, SaveRun  # noqa: E402
from share.protocol.edge_events import AddKeyframe, AddRun  # noqa: E402
from share.runtime.cluster_process import ClusterProcess  # noqa: E402
from share.runtime.keyframe_handover import KeyframesAdded  # noqa: E402
from share.runtime.mapper_process import StartMapper, start_mapper_process  # noqa: E402
from share.runtime.remote_room import RemoteRooms  # noqa: E402
from share.store.map_store import MapStore  # noqa: E402
from share.types import AgentKind, Keyframe, KeyframeImage, View  # noqa: E402
from share.wire.messages import Hello  # noqa: E402

_FEATURES, _JPEG_BYTES, _RUN = 800, 17_000, "ann-0001"
_WARM = 20  # keyframes that do not count
_PAUSE_S = 0.03


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=400)
    parser.add_argument("--folder", type=Path, help="folder on the disk to measure")
    options = parser.parse_args()
    keyframes = [_keyframe(i) for i in range(options.keyframes + _WARM)]
    cluster = ClusterProcess("local")
    remote = RemoteRooms(cluster.start_worker)
    print(json.dumps({"answer": _answers(remote, keyframes)}), flush=True)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        print(json.dumps({"write": _writes(remote, keyframes, Path(folder))}), flush=True)
    cluster.close()


def _answers(remote: RemoteRooms, keyframes: list[Keyframe]) -> dict[str, Any]:
    answers: dict[str, queue.SimpleQueue[Any]] = {"here": queue.SimpleQueue(), "ray": queue.SimpleQueue()}
    mappers: dict[str, Any] = {
        "here": start_mapper_process(answers["here"].put, print),
        "ray": remote.start_mapper(answers["ray"].put, print, 0.0),
    }
    for mapper in mappers.values():
        mapper.send(StartMapper(Config()))
        mapper.send(AddRun(_RUN, _hello()))

    def timed(name: str, keyframe: Keyframe) -> float:
        began_s = time.perf_counter()
        mappers[name].send(AddKeyframe(_RUN, keyframe))
        while not isinstance(answers[name].get(), KeyframesAdded):
            pass
        return 1e3 * (time.perf_counter() - began_s)

    result = _by_turns(timed, keyframes)
    for mapper in mappers.values():
        mapper.close()
    return result


def _writes(remote: RemoteRooms, keyframes: list[Keyframe], folder: Path) -> dict[str, Any]:
    for name in ("here", "ray"):
        with MapStore.open(folder / f"{name}.sqlite") as store:
            store.write([SaveRun(_RUN, _hello(), "")])
    stores: dict[str, Any] = {
        "here": MapStore.open(folder / "here.sqlite"),
        "ray": remote.open_room(folder / "ray.sqlite").store,
    }

    def timed(name: str, keyframe: Keyframe) -> float:
        began_s = time.perf_counter()
        stores[name].write([SaveKeyframe(_RUN, keyframe)])
        return 1e3 * (time.perf_counter() - began_s)

    result = _by_turns(timed, keyframes)
    for store in stores.values():
        store.close()
    return result


def _by_turns(timed: Callable[[str, Keyframe], float], keyframes: list[Keyframe]) -> dict[str, Any]:
    took: dict[str, list[float]] = {"here": [], "ray": []}
    for i, keyframe in enumerate(keyframes):
        for name in sorted(took, reverse=bool(i % 2)):
            took[name].append(timed(name, keyframe))
            time.sleep(_PAUSE_S)
    more = np.subtract(took["ray"], took["here"])[_WARM:]
    numbers = {name: np.asarray(one[_WARM:]) for name, one in took.items()} | {"more": more}
    return {
        name: {"p50": round(float(np.median(one)), 2), "p95": round(float(np.quantile(one, 0.95)), 2)}
        for name, one in numbers.items()
    }


def _hello() -> Hello:
    noise = ImuNoise(1.7e-4, 2.0e-3, 1.9e-5, 3.0e-3, 200.0)
    rig = Rig(Camera(640, 480, 400.0, 400.0, 319.5, 239.5), np.eye(4), imu=noise)
    return Hello("ann", AgentKind.AR, 1, rig)


def _keyframe(i: int) -> Keyframe:
    """Along a line, and unlike all others."""
    rng = np.random.default_rng(i)
    pixels = rng.uniform(0, 640, (_FEATURES, 2))
    descriptors = rng.integers(0, 256, (_FEATURES, 32), np.uint8)
    view = View(pixels, rng.normal(size=(_FEATURES, 3)), descriptors)
    surfaces = rng.normal(size=(3, 2)), rng.uniform(0.2, 1, (3, 3)), rng.uniform(0, 0.1, 3)
    image = KeyframeImage(rng.integers(0, 256, _JPEG_BYTES, np.uint8), *surfaces)
    T, step = np.eye(4), np.eye(4)
    T[0, 3], step[0, 3] = 0.1 * i, 0.1 if i else 0.0
    cov = np.diag([1e-6, 1e-6, 1e-6, 1e-5, 1e-5, 2e-5])
    up = np.array([0.0, 0.0, 1.0])
    return Keyframe(i, i - 1, 10**9 + i * 10**8, step, cov, T, up, 0.01, view, i - 1, image)


if __name__ == "__main__":
    main()
