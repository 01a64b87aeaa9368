"""Trackers of others, each at the end of a pipe in an interpreter of its own.

`basalt.py` and `orbslam3.py` are scripts: they need their peer's package and numpy, nothing of SHARE, so that
a peer's requirements never meet ours. `peer_wire.py` is what both ends of the pipe use.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PeerTracker:
    """title: for a reader. package: as pip takes it. vocabulary: it needs a file that its package has not."""

    title: str
    package: str
    script: str
    needs_vocabulary: bool = False

    @property
    def path(self) -> Path:
        return Path(__file__).parent / self.script

    @property
    def install(self) -> str:
        return f"python -m venv DIR && DIR/bin/pip install {self.package}"


PEERS = {
    "basalt": PeerTracker("Basalt", "depthai==3.12.0", "basalt.py"),
    "orbslam3": PeerTracker("ORB-SLAM3", "pyorbslam3==0.1.1", "orbslam3.py", needs_vocabulary=True),
}
