"""Ctrl-C, SIGTERM and SIGHUP at any moment of a command: one line at most, and the shell's exit code."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from helpers.recordings import make_euroc

ENDED = {
    signal.SIGINT: {130, -signal.SIGINT},  # shells call both 130
    signal.SIGTERM: {143, -signal.SIGTERM},
    signal.SIGHUP: {129, -signal.SIGHUP},
}
STEPS_S = (0.005, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0)
PROGRAM = "import os; from share.__main__ import run; os.write(1, b'.'); run()"
# From where SHARE looks after Ctrl-C: what comes while Python itself starts is Python's to handle.
LOOKED_AFTER = """
import os, signal
set_handler = signal.signal
def first(*given):
    signal.signal = set_handler
    set_handler(*given)
    os.write(1, b'.')
signal.signal = first
from share.__main__ import run
run()
"""


def commands(folder: Path) -> dict[str, list[str]]:
    walk, nobody = str(folder / "walk"), "tcp://127.0.0.1:9"
    return {
        "edge": ["edge", "--bind", "tcp://127.0.0.1:0", "--map", str(folder / "m.sqlite")],
        "agent": ["agent", walk, "--name", "a", "--kind", "ar", "--edge", nobody, "--out", str(folder / "a")],
        "track": ["track", walk, "--out", str(folder / "t.tum")],
        "demo": ["demo", "--scene", "plain", "--seconds", "3", "--seed", "18", "--out", str(folder / "demo")],
        "capture": ["capture", "realsense", "--out", str(folder / "c.mcap")],
        "evaluate": ["evaluate", "run", walk, "--out", str(folder / "evaluated")],
    }


def ended(arguments: list[str], after_s: float, number: int) -> tuple[int, str]:
    """Return exit code and stderr of a command that gets a signal after a delay."""
    process = subprocess.Popen(
        [sys.executable, "-c", LOOKED_AFTER, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.read(1) == b"."
    time.sleep(after_s)
    process.send_signal(number)
    try:
        _, said = process.communicate(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()
        raise AssertionError(f"goes on, {after_s} s: {process.communicate()[1].decode()}") from None
    return process.returncode, said.decode()


def printed(program: str) -> str:
    """Return the output of a Python program that ends with code 0 and an empty stderr."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def check(folder: Path, command: str, number: int, steps: Sequence[float]) -> None:
    make_euroc(folder / "walk", frames=40)
    for after_s in steps:
        code, said = ended(commands(folder)[command], after_s, number)
        assert code in {0, 1, 2, *ENDED[number]}, (
            after_s,
            code,
            said,
        )  # 0 to 2: it was at its end, or told to be
        for word in ("Traceback", "ignored", "Error:"):
            assert word not in said, (after_s, said)


@pytest.mark.long
@pytest.mark.parametrize("command", ["edge", "track"])
def test_ctrl_c(tmp_path, command):
    check(tmp_path, command, signal.SIGINT, (0.005, 0.1, 0.4))


@pytest.mark.slow
@pytest.mark.parametrize("number", list(ENDED))
@pytest.mark.parametrize("command", ["edge", "agent", "track", "demo", "capture", "evaluate"])
def test_interrupt_at_any_moment_ends_with_one_line(tmp_path, monkeypatch, plain_cache, command, number):
    monkeypatch.setenv("XDG_CACHE_HOME", str(plain_cache))  # the demo's session
    check(tmp_path, command, number, STEPS_S)


def test_interrupt_before_the_command_starts_is_one_line(tmp_path):
    assert ended(["edge"], 0.005, signal.SIGINT) == (130, "share: interrupted\n")


def test_ignored_signal_stays_ignored(tmp_path):
    """As of `share … &` in a script."""
    program = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); {PROGRAM}"
    process = subprocess.Popen(
        [sys.executable, "-c", program, "--version"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout.read(1) == b"."
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (0, b"")
    assert out.startswith(b"share")


def test_import_is_not_interrupted(tmp_path):
    """poselib makes a RuntimeError of it: then Ctrl-C ended `share track` with a traceback."""
    (tmp_path / "swallows.py").write_text(
        "import os, signal, time\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\n    time.sleep(0.2)\n"
        "except BaseException as error:\n    raise RuntimeError('cannot be imported') from error\n"
    )
    program = (
        "import sys, time\nfrom share.runtime.signals import unwind_on_signal\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\n"
        "try:\n    with unwind_on_signal():\n        import swallows\n        time.sleep(10)\n"
        "except KeyboardInterrupt:\n    print('interrupted')\n"
    )
    assert printed(program) == "interrupted\n"


def test_signal_during_a_worker_start_leaves_no_process():
    """It would say that it got no work (EOFError), with a traceback. The signal goes to another thread, which
    does not hold it back, while the worker is started."""
    program = (
        "import os, signal, threading, time\n"
        "from multiprocessing import popen_spawn_posix as spawning\n"
        "from share.runtime.signals import unwind_on_signal\n"
        "from share.spawning import SPAWN_CONTEXT\n"
        "threading.Thread(target=time.sleep, args=(2.0,), daemon=True).start()\n"
        "start = spawning.util.spawnv_passfds\n"
        "def interrupted(*arguments):\n"
        "    worker = start(*arguments)\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(0.1)\n"
        "    return worker\n"
        "spawning.util.spawnv_passfds = interrupted\n"
        "worker = SPAWN_CONTEXT.Process(target=print, args=('worked',))\n"
        "try:\n    with unwind_on_signal():\n        worker.start()\n"
        "except KeyboardInterrupt:\n    worker.join()\n    print('interrupted')\n"
    )
    assert printed(program) == "worked\ninterrupted\n"


@pytest.mark.long
@pytest.mark.parametrize("number", list(ENDED))
def test_worker_without_an_owner_does_not_delay_the_end(number):
    """The signal comes when the mapper process runs but the edge does not own it yet."""
    program = (
        "import os\n"
        "from share.__main__ import run\n"
        "from share.runtime.worker_process import WorkerProcess\n"
        "begin = WorkerProcess.__init__\n"
        "def interrupted(self, *about):\n"
        "    begin(self, *about)\n"
        f"    os.kill(os.getpid(), {int(number)})\n"
        "WorkerProcess.__init__ = interrupted\n"
        "run()\n"
    )
    command = [sys.executable, "-c", program, "edge", "--bind", "tcp://127.0.0.1:0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert done.returncode in ENDED[number]
    assert done.stderr == ("share: interrupted\n" if number == signal.SIGINT else "")


def test_signal_deferred_by_an_import_is_deferred_by_a_worker_start():
    """A signal that came while a module was imported is handled 20 ms later: while a worker is started."""
    program = (
        "import os, signal, time\n"
        "from multiprocessing import popen_spawn_posix as spawning\n"
        "from share.runtime import signals as module\n"
        "from share.spawning import SPAWN_CONTEXT\n"
        "start = spawning.util.spawnv_passfds\n"
        "def slow(*arguments):\n"
        "    worker = start(*arguments)\n"
        "    time.sleep(0.1)\n"
        "    return worker\n"
        "worker = SPAWN_CONTEXT.Process(target=print, args=('worked',))\n"
        "spawning.util.spawnv_passfds = slow\n"
        "importing = iter([True])\n"
        "module.is_importing = lambda frame: next(importing, False)\n"
        "try:\n    with module.unwind_on_signal():\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n        worker.start()\n"
        "except SystemExit:\n    worker.join()\n    print('ended')\n"
    )
    assert printed(program) == "worked\nended\n"
