"""After a writer is killed all that `write` returned for is stored once, and at most the list in flight."""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from share.store.map_store import MapStore

WRITER = """
import random, sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from helpers.map_changes import ANN, keyframe, run, solution
from share.store.map_store import MapStore

draw = random.Random(int(sys.argv[2]))
with MapStore.open(Path(sys.argv[1])) as store:
    following = store.load().next_ids.get(ANN, 0)
    store.write([run(ANN)])
    while True:
        frames = [keyframe(ANN, following + i, 200) for i in range(draw.randrange(1, 6))]
        following += len(frames)
        news = [*frames, solution([k.keyframe_key for k in frames])]
        print("offered", following, flush=True)
        store.write(news)
        print("written", following, flush=True)
"""


@pytest.mark.long
@pytest.mark.parametrize("kills", [5, pytest.param(50, marks=pytest.mark.slow)])
def test_a_writer_killed_at_random_instants_loses_nothing_written(tmp_path, kills):
    path = tmp_path / "room.sqlite"
    draw = random.Random(kills)
    written, logs = 0, 0
    for life in range(kills):
        offered, acknowledged = life_and_death(path, life, draw.uniform(0, 0.2))
        logs += path.with_name("room.sqlite-wal").exists()
        with MapStore.open(path) as store:
            kept = store.load()
        numbers = [k.keyframe_key.id for k in kept.keyframes]
        assert numbers == list(range(len(numbers)))  # each once, in order, none missing
        assert len(numbers) in {offered, max(acknowledged, written)}  # all of a list or none
        assert len(numbers) >= max(acknowledged, written)
        assert kept.problems == ()
        if numbers:
            assert kept.poses.keys[-1].id == numbers[-1]  # the solution of the same list
        written = len(numbers)
    assert written > 5 * kills
    assert logs > kills / 2  # it was killed in its work, not closed


def life_and_death(path: Path, seed: int, seconds: float) -> tuple[int, int]:
    """The last ids that were passed to `write`, and written."""
    command = [sys.executable, "-c", WRITER, str(path), str(seed), str(Path(__file__).parents[1])]
    writer = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    first = writer.stdout.readline()
    try:
        writer.wait(seconds)
    except subprocess.TimeoutExpired:
        writer.send_signal(signal.SIGKILL)
    lines = [first, *writer.stdout]
    assert writer.wait() == -signal.SIGKILL
    writer.stdout.close()
    said = [line.split() for line in lines if line.endswith("\n")]
    last = {word: int(number) for word, number in said}
    return last.get("offered", 0), last.get("written", 0)
