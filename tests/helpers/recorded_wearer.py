"""An emulated headset on the head of a recording's agent: it moves along the recording's ground truth, while
the agent tracks what the recording's cameras saw.

When the agent began to play is found by its poses in the page: for the right moment the poses and the truth
differ by one transform.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from helpers import emulated_wearer as worn
from helpers.browser import BrowserPage
from scipy.spatial.transform import Rotation, Slerp

from share.geometry import se3
from share.recordings.trajectory import read_tum
from share.types import F64

_STEP_S = 0.005  # of the path that the headset is given
_TURNED = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])  # local: y up, the floor at 0
T_local_world = se3.from_rt(_TURNED, np.zeros(3))

# Moves the headset along `path`: rows of x y z and a quaternion, of which the first is at beganMs.
_SCRIPT = """
    window.path = null;
    const walked = window.move;
    window.move = (wallMs) => {
        walked(wallMs);
        if (path === null) return;
        const k = Math.min(Math.max((wallMs - path.beganMs) / path.stepMs, 0), path.poses.length - 1.001);
        const [a, b] = [path.poses[Math.floor(k)], path.poses[Math.floor(k) + 1]];
        const sign = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] < 0 ? -1 : 1;
        const at = a.map((value, i) => value + (k % 1) * ((i < 3 ? 1 : sign) * b[i] - value));
        const length = Math.hypot(...at.slice(3));
        headset.position.set(...at.slice(0, 3));
        headset.quaternion.set(...at.slice(3).map((value) => value / length));
    };
"""


class RecordedWalk:
    """truth: of the device in the world, in a file (TUM). mount: T_body_viewer."""

    def __init__(self, truth: Path, mount: F64) -> None:
        stamps_ns, T = read_tum(truth)
        stamps_s = 1e-9 * (stamps_ns - stamps_ns[0])
        self._mount, self._times_s = mount, np.arange(0.0, stamps_s[-1], _STEP_S)
        self._T_world_body = np.tile(np.eye(4), (len(self._times_s), 1, 1))
        turned = Slerp(stamps_s, Rotation.from_matrix(T[:, :3, :3]))(self._times_s)
        self._T_world_body[:, :3, :3] = turned.as_matrix()
        for i in range(3):
            self._T_world_body[:, i, 3] = np.interp(self._times_s, stamps_s, T[:, i, 3])

    def began_ms(self, page: BrowserPage, agent: str, seconds: float = 4.0) -> float:
        """Return when the first frame arrived at the agent, ms of the server's clock."""
        seen, last_map = dict[float, list[float]](), ""
        own = "((one) => one?.isPosed ? [one.mapId, one.stampMs, [...one.T]] : null)"
        began_s = time.monotonic()
        while time.monotonic() < began_s + seconds or len(seen) < 20:
            if (found := page.app(f"{own}(app.room.agents.get({agent!r}))")) is not None:
                map_id, stamp_ms, T = found
                if map_id != last_map:  # joined, or the first one
                    seen, last_map = {}, map_id
                seen[stamp_ms] = T
            assert time.monotonic() < began_s + seconds + 60, f"{len(seen)} poses of '{agent}'"
        stamps_s = np.array(list(seen)) / 1e3
        T_map_body = np.array([np.reshape(T, (4, 4), order="F") for T in seen.values()])
        begins = np.arange(stamps_s[-1] - self._times_s[-1], stamps_s[0], _STEP_S)
        costs = [self._cost(stamps_s - begin, T_map_body) for begin in begins]
        print(f"{len(seen)} poses of '{agent}' agree with the truth within {min(costs):.3f} m and rad")
        return 1e3 * float(begins[int(np.argmin(costs))])

    def _cost(self, times_s: F64, T_map_body: F64) -> float:
        """How much the transform between map and world varies, m and rad."""
        T_world_body = self._T_world_body[
            np.rint(times_s / _STEP_S).astype(int).clip(0, len(self._times_s) - 1)
        ]
        R = T_map_body[:, :3, :3] @ T_world_body[:, :3, :3].transpose(0, 2, 1)
        middle = np.median(R, axis=0)
        turned = np.linalg.norm(R - middle, axis=(1, 2))
        moved = T_map_body[:, :3, 3] - T_world_body[:, :3, 3] @ middle.T
        return float(np.median(turned) + np.median(np.linalg.norm(moved - np.median(moved, axis=0), axis=1)))

    def wear(self, page: BrowserPage, agent: str) -> None:
        """Let the page's headset go along with the agent."""
        began_ms = self.began_ms(page, agent)
        to_wall_ms = 1e3 * time.time() - time.monotonic_ns() / 1e6
        T = T_local_world @ self._T_world_body @ self._mount
        rows = np.concatenate([T[:, :3, 3], se3.quat_from_matrix(T[:, :3, :3])], axis=1).round(6).tolist()
        path = {"beganMs": began_ms + to_wall_ms, "stepMs": 1e3 * _STEP_S, "poses": rows}
        page.evaluate(f"(() => {{{_SCRIPT}}})()")
        page.evaluate(f"(path = {json.dumps(path)}, 0)")
        worn.wait_frames(page, 3)
