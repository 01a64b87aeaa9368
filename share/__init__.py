"""SHARE: user-centric collaborative SLAM for people in AR headsets and robots in one room.

Each agent tracks itself; one edge server joins their maps and sends each agent corrections. The command
line is `share --help`. Track a recording from Python:

    from share.config import Config
    from share.runtime.offline_tracking import track
    from share.runtime.source import open_source

    run = track(open_source("room1/ann"), Config(), on_result=lambda result: None)
    stamps_ns, T_odom_body = run.trajectory  # (N,), (N, 4, 4)

The packages, from the top down (each imports only those below it; `help(share.odometry)` says more of
one):

    cli          one file a command
    lab          emulator, calibration, evaluation, training: what a headset never loads
    runtime      the processes: agent, edge, mapper; status page
    cameras      live cameras
    store        the edge's map on disk
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

__version__ = "0.2.0"
