"""SHARE: user-centric collaborative SLAM for people in AR headsets and robots in one room.

Each agent tracks itself; one edge server joins their maps and sends each agent corrections. The command
line is `share --help`. Track a recording from Python (docs/lookup/api.md):

    from share import Tracker, open_recording

    recording = open_recording("room1/ann")
    tracker = Tracker(recording.rig)
    poses = [pose for frame in recording if (pose := tracker.track(frame))]

The packages, from the top down (each imports only those below it; `help(share.odometry)` says more of
one):

    cli          one file a command
    lab          emulator, calibration, evaluation, training: what a headset never loads
    library      what `from share import` gives to programs
    headset      the server of the page that wearers see
    runtime      the processes: agent, edge, mapper; status page
    view         the live room
    cameras      live cameras
    store        the edge's map on disk
    robot        a robot's place in the map, and its goals
    devices      checks of a device, clocks
    net          links between agents and edge, keys
    recordings   readers of recordings, sessions, calibration files
    protocol     agent and edge as state machines
    mapping      keyframes in, corrections out: recognition, loops, pose graph
    scheduling   QoE, keyframe rates, policies, merge gate
    odometry     frames in, poses and keyframes out
    sensors      samples of sensors to frames; profiles of devices
    wire         messages and their bytes
    files        bounded reading, atomic writing
    metrics      ATE, RPE, latency
    vision       corners, optical flow, patches, ORB
    geometry     SE(3), cameras, lenses

From `protocol` down, except `files`, all is pure: no clock, thread, socket, file or global randomness.
Settings are in `config`, the values that all packages use in `types`, and units and frames in
docs/understand/architecture.md.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from share.config import Config
    from share.errors import ShareError
    from share.geometry.camera import Rig
    from share.library.agent import AgentThread as Agent
    from share.library.edge import EdgeThread as Edge
    from share.library.recording import load_calibration, open_recording
    from share.library.room import RoomThread as Room
    from share.library.tracker import Tracker
    from share.runtime.pose import Pose
    from share.types import Frame

__version__ = "0.2.0"

_NAMES = {  # where each name is; imported when it is used, so that `import share` is quick
    "Agent": ("share.library.agent", "AgentThread"),
    "Config": ("share.config", "Config"),
    "Edge": ("share.library.edge", "EdgeThread"),
    "Frame": ("share.types", "Frame"),
    "Pose": ("share.runtime.pose", "Pose"),
    "Rig": ("share.geometry.camera", "Rig"),
    "Room": ("share.library.room", "RoomThread"),
    "ShareError": ("share.errors", "ShareError"),
    "Tracker": ("share.library.tracker", "Tracker"),
    "load_calibration": ("share.library.recording", "load_calibration"),
    "open_recording": ("share.library.recording", "open_recording"),
}

__all__ = [  # the interface that stays; all else may change between releases
    "Agent",
    "Config",
    "Edge",
    "Frame",
    "Pose",
    "Rig",
    "Room",
    "ShareError",
    "Tracker",
    "load_calibration",
    "open_recording",
]


def __getattr__(name: str) -> Any:
    """Import a name of the interface on first use (PEP 562)."""
    if name not in _NAMES:
        raise AttributeError(f"module 'share' has no attribute '{name}'")
    module, attribute = _NAMES[name]
    value = globals()[name] = getattr(import_module(module), attribute)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
