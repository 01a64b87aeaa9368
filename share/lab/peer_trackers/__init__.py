"""Other trackers, each run in an interpreter of its own at the end of a pipe.

`basalt.py` and `orbslam3.py` are scripts that need their tracker's package and numpy but nothing of
SHARE, so that requirements never conflict. Both ends of the pipe use `peer_wire.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PeerTracker:
    """`title`: for readers. `package`: requirement for pip. `needs_vocabulary`: it needs a file that its
    package lacks."""

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
