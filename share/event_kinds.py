"""The kinds of lines in events.jsonl; their meanings are in docs/lookup/files.md."""

from typing import Literal

EventKind = Literal[
    # agents come and go
    "agent joined",
    "left",
    "silent",
    "reconnected",
    "refused",
    "room full",
    "room changed",
    "connection refused",
    "forgotten",
    "expired",
    # clients, objects, robots
    "client joined",
    "client left",
    "objects moved",
    "object removed",
    "robot commanded",
    "robot answered",
    # what they send
    "bad message",
    "odometry suspect",
    "tracking lost",
    # loops and maps
    "loop refused",
    "loop not accepted",
    "loop accepted",
    "maps merged",
    "merge skipped",
    "merge undone",
    "map renewed",
    "correction",
    "correction held back",
    "agent quarantined",
    "agents disputed",
    "quarantine lifted",
    # what fails at the edge
    "step failed",
    "solver died",
    "mapper died",
    "map",
    "write failed",
    "internal error",
]
