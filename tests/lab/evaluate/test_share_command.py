"""SHARE's commands as child processes."""

import subprocess

from share import __version__
from share.lab.evaluate.real_time import share_command


def test_a_folder_named_share_in_the_working_directory_is_ignored(tmp_path):
    (tmp_path / "share").mkdir()
    reported = subprocess.run(
        share_command("--version"), cwd=tmp_path, capture_output=True, text=True, timeout=30
    )
    assert (reported.returncode, reported.stderr) == (0, "")
    assert __version__ in reported.stdout
