"""What a shell completes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from share.config import POLICY_NAMES
from share.lab.emulate.world.scenes import SCENES
from share.sensors.profile import shipped_profiles


def completed(line: str) -> list[str]:
    """The values that bash is offered for the last word of `line`, which may be empty."""
    words = {
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split(" ")) - 1),
        "_SHARE_COMPLETE": "bash_complete",
    }
    command = [sys.executable, "-m", "share"]
    done = subprocess.run(command, env={**os.environ, **words}, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return [row.partition(",")[2] for row in done.stdout.splitlines()]


def test_commands_policies_scenes_and_profiles_complete():
    assert completed("share ed") == ["edge"]
    assert completed("share edge --policy ") == list(POLICY_NAMES)
    assert completed("share emulate --scene ") == [*SCENES, "plain"]
    assert completed("share emulate --scene w") == ["warehouse", "whitewall"]
    assert completed("share capture --profile d435i-") == ["d435i-n100-headset", "d435i-turtlebot4"]
    assert set(completed("share doctor --profile ")) == set(shipped_profiles())
    assert completed("share dataset export --format ") == ["tum", "mcap", "rrd", "colmap", "kitti"]


@pytest.mark.parametrize("option", ["emulate --scene", "track --profile"])
def test_files_complete_where_no_name_fits(option):
    assert completed(f"share {option} ./my") == ["./my"]


def test_a_profile_of_one_agent_completes_after_its_name():
    assert completed("share emulate --profile ann=eu") == ["ann=euroc"]
