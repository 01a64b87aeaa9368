"""SHARE's commands as child processes."""

import signal
import subprocess
import sys

from share import __version__
from share.lab.evaluate import real_time
from share.lab.evaluate.real_time import share_command


def test_a_folder_named_share_in_the_working_directory_is_ignored(tmp_path):
    (tmp_path / "share").mkdir()
    reported = subprocess.run(
        share_command("--version"), cwd=tmp_path, capture_output=True, text=True, timeout=30
    )
    assert (reported.returncode, reported.stderr) == (0, "")
    assert __version__ in reported.stdout


def test_a_child_that_does_not_end_is_killed_and_that_is_what_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(real_time, "_STOP_S", 0.5)
    code = "from signal import *; import time; signal(SIGINT, SIG_IGN); print(flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        assert real_time.stop_child(child) == -signal.SIGKILL
    log = tmp_path / "edge.log"
    log.write_text("   55.912 s left: robot: sent bye\n")
    assert real_time._why_it_failed(1, log) == "   55.912 s left: robot: sent bye"
    said = real_time._why_it_failed(-signal.SIGKILL, log)
    assert "killed" in said and "bye" not in said
