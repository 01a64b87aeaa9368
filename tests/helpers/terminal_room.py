"""A terminal in place of stderr, and what an edge's status page says of one agent."""

from __future__ import annotations

import io

AGENT = {
    **{"kind": "ar", "state": "OK", "pose_ms": 6.0, "qoe": 0.8, "qoe_target": 0.75, "rate_hz": 3.2},
    **{"keyframes": 12, "gone": False, "trouble": []},
}
REPORT = {"agents": {"ann": AGENT}}
PART = {"map_id": "a", "path": [[0.0, 0.0], [1.0, 0.0]]}
PLAN = {
    "agents": {"ann": {"kind": "ar", "map_id": "a", "parts": [PART], "position": [1.0, 0.0], "heading": 0.0}}
}


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True
