"""How long an edge with a large map file takes to listen, and to recognise a place of the restored map.

    python tools/experiments/measure_restart.py [--keyframes 2000 20000] [--folder DIR]

The map is of 24 agents on the tracks of an emulated room (`load_tracks`), with an image and a view each.
Prints one JSON object a size: size of the file; seconds until `share edge --map` listens, CPU s and memory of
its front then. Then, in one process, CPU s until the map is read, decoded and restored, until the first
keyframe of a new agent is verified against it, and until all of it is indexed; and what it takes of memory.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from keyframe_odometry import Drift, odometry  # noqa: E402
from keyframe_set import AgentKeyframes  # noqa: E402
from load_tracks import room  # noqa: E402
from measure_load import cpu_s, rss_mb  # noqa: E402

from share.config import Config  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.mapping.loops import KeyframeKey  # noqa: E402
from share.mapping.map_changes import MapChange, SaveKeyframe, SavePoses, SaveRun, SaveView  # noqa: E402
from share.mapping.mapper import Mapper  # noqa: E402
from share.mapping.recognition.patch_alignment import ImageView  # noqa: E402
from share.mapping.steps import IndexStep  # noqa: E402
from share.startup import HeapTrimmer  # noqa: E402
from share.store.keyframe_archive import KeyframeArchive  # noqa: E402
from share.store.loading import decode_map  # noqa: E402
from share.store.map_store import MapStore  # noqa: E402
from share.types import Keyframe, View  # noqa: E402
from share.vision.packed_view import PackedView  # noqa: E402
from share.wire.messages import Hello  # noqa: E402

_AGENTS, _BATCH = 24, 100
_FLIPPED = 0.02  # share of a descriptor's bits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--keyframes", type=int, nargs="*", default=[2000, 20000])
    parser.add_argument("--folder", type=Path, help="folder on the disk to measure")
    options = parser.parse_args()
    tracks = list(room().agents.values())
    views = [[PackedView.pack(_described(one, k)) for k in one.keyframes] for one in tracks]
    for count in options.keyframes:
        with tempfile.TemporaryDirectory(dir=options.folder) as name:
            path = Path(name) / "map.sqlite"
            write_map(path, count, tracks, views)
            print(json.dumps({"keyframes": count, **restart(path), **recognise(path, tracks[0])}), flush=True)


def _described(agent: AgentKeyframes, keyframe: Keyframe) -> View:
    rig = agent.hello.rig
    return ImageView(keyframe.image, rig.cam0, rig.T_body_cam0).describe()


def write_map(path: Path, count: int, tracks: list[AgentKeyframes], views: list[list[PackedView]]) -> None:
    """Write a map of `_AGENTS` agents that walk the tracks again and again, each lap a segment."""
    rng = np.random.default_rng(0)
    with MapStore.open(path) as store:
        keys, poses = list[KeyframeKey](), []
        for number in range(_AGENTS):
            track, of_track = tracks[number % len(tracks)], views[number % len(tracks)]
            run = f"agent{number}-0000"
            hello = track.hello
            store.write([SaveRun(run, Hello(f"agent{number}", hello.kind, number, hello.rig))])
            changes: list[MapChange] = []
            for keyframe, view, T in _laps(track, of_track, -(-count // _AGENTS), rng):
                changes += [SaveKeyframe(run, keyframe), SaveView(KeyframeKey(run, keyframe.id), view)]
                keys.append(KeyframeKey(run, keyframe.id))
                poses.append(T)
                if len(changes) >= _BATCH:
                    store.write(changes)
                    changes = []
            store.write(changes)
        store.write([SavePoses(tuple(keys), np.array(poses), ("agent0-0000/0",) * len(keys))])


def _laps(
    track: AgentKeyframes, views: list[PackedView], count: int, rng: np.random.Generator
) -> Iterator[tuple[Keyframe, PackedView, Any]]:
    """Yield `count` keyframes with their views and true poses."""
    stamps_ns = np.array([one.stamp_ns for one in track.keyframes])
    made = 0
    while True:
        T, cov = odometry(track.T_world_body, stamps_ns, rng, Drift())
        for k, source in enumerate(track.keyframes):
            if made == count:
                return
            step = se3.inverse(T[k - 1]) @ T[k] if k else T[k]
            keyframe = Keyframe(
                made, made - 1 if k else -1, made * 10**8, step, cov[k], T[k], T[k][2, :3], Drift().tilt_rad,
                View.empty(), made - 1, source.image,
            )  # fmt: skip
            flips = np.packbits(rng.random((len(views[k]), 256)) < _FLIPPED, axis=1)
            yield keyframe, replace(views[k], descriptors=views[k].descriptors ^ flips), track.T_world_body[k]
            made += 1


def restart(path: Path) -> dict[str, Any]:
    """Start an edge with the map and end it."""
    command = [sys.executable, "-m", "share", "edge", "--bind", "tcp://127.0.0.1:0", "--map", str(path)]
    began = time.monotonic()
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as edge:
        assert edge.stderr is not None
        while "listening" not in (line := edge.stderr.readline()):
            if not line:
                raise RuntimeError("the edge has ended")
        spent = {
            "listens_s": round(time.monotonic() - began, 2),
            "listens_cpu_s": round(cpu_s(edge.pid), 2),
            "front_mb": round(rss_mb(edge.pid), 1),
        }
        edge.terminate()
        edge.stderr.read()
    return {"file_mb": round(path.stat().st_size / 1e6, 1), **spent}


def recognise(path: Path, track: AgentKeyframes) -> dict[str, float]:
    """Restore the map in a mapper, and look up keyframes of a new agent in it."""
    out, before_mb = {}, trimmed_mb()
    began = time.process_time()

    def spent(what: str) -> None:
        out[what] = round(time.process_time() - began, 2)

    with MapStore.read(path) as store:
        spent("read_s")
        kept = decode_map(store.rows().copy())
    spent("decoded_s")
    mapper = Mapper(Config(), KeyframeArchive(path))
    mapper.restore(kept)
    spent("restored_s")
    mapper.add_run("eve-0001", Hello("eve", track.hello.kind, 99, track.hello.rig))
    coming, indexed = iter(track.keyframes), 0
    while "recognised_s" not in out or "indexed_s" not in out:
        step = mapper.next_lookup()
        if "recognised_s" not in out and (step is None or isinstance(step, IndexStep)):
            mapper.add_keyframe("eve-0001", next(coming))
        if step is not None:
            mapper.finish_step(step, step.run(), 0.0)
        indexed += len(step.entries) if isinstance(step, IndexStep) else 0
        if indexed == len(kept.keyframes):
            out.setdefault("indexed_s", round(time.process_time() - began, 2))
        if "recognised_s" not in out and mapper.report()["agents"]["eve-0001"]["merges"]["requested"]:
            spent("recognised_s")
            out["indexed_then"] = indexed
    count = len(kept.keyframes)
    del kept, step
    out["mapper_kb_a_keyframe"] = round(1e3 * (trimmed_mb() - before_mb) / count, 1)
    return out


def trimmed_mb() -> float:
    """Memory of this process, after free heap is given back."""
    heap = HeapTrimmer()
    heap.trim_if_due(0.0)
    heap.trim_if_due(1e6)
    return rss_mb(os.getpid())


if __name__ == "__main__":
    main()
