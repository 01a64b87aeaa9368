"""Many agents from the few of an emulated session: each walks one of its tracks, from another start.

The tracker runs over each recording once; what it offers is replayed, with more noise in every image, so that
no two agents send equal ones. At the end of a track an agent starts it again as a new odometry segment.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from share.config import Config
from share.earlier_poses import EarlierPoses
from share.geometry.camera import Rig
from share.lab.evaluate.simulation import TrackedFrame
from share.lab.evaluate.virtual_time import track_agent
from share.recordings.session import Session
from share.runtime.source import open_source
from share.types import AgentKind, OdometryKeyframe
from share.vision.keyframe_images import Surfaces, decompress
from share.wire.messages import Hello

_GRAY = 3.0  # gray levels, standard deviation of a pixel


@dataclass(frozen=True, eq=False)
class Track:
    """One agent of a session: what its tracker gave."""

    kind: AgentKind
    rig: Rig
    frames: list[TrackedFrame]


def track_session(session: Session) -> list[Track]:
    """Track all agents of a session; takes about half as long as they walked."""
    config, found = Config(), []
    for name, agent in session.agents.items():
        source = open_source(f"{session.folder.resolve()}/{name}")
        rig, frames = track_agent(source, config, 0, config.agent.error_model)
        found.append(Track(agent.kind, rig, frames))
    return found


class ReplayedAgent:
    """An agent without end. index: decides its track, its run id and all random numbers."""

    def __init__(self, tracks: list[Track], index: int) -> None:
        self._track, self._rng = tracks[index % len(tracks)], np.random.default_rng((index, 6))
        run_id = int(self._rng.integers(2**63))
        self.hello = Hello(f"agent{index}", self._track.kind, run_id, self._track.rig)

    def frames(self, seconds: float) -> Iterator[TrackedFrame]:
        """Yield its frames in this time; they arrive from 0 on."""
        frames = self._track.frames
        period_ns = (frames[-1].arrival_ns - frames[0].arrival_ns) // (len(frames) - 1)
        needed = round(seconds * 1e9 / period_ns)
        first = int(self._rng.integers(max(1, len(frames) - needed)))  # so that a long track is walked once
        is_begun = False  # the present segment has a keyframe
        start_ns = int(self._rng.integers(period_ns))
        for k, arrival_ns in enumerate(range(start_ns, round(seconds * 1e9), period_ns), first):
            lap, at = divmod(k, len(frames))
            frame, lap_ns = frames[at], lap * len(frames) * period_ns
            is_begun = is_begun and at > 0
            candidate = frame.candidate and self._seen_anew(frame.candidate, lap_ns, is_begun)
            is_begun |= candidate is not None
            stamp_ns = arrival_ns if frame.stamp_ns is None else frame.stamp_ns + lap_ns
            is_new = frame.new_segment or k == first or at == 0
            yield replace(
                frame, arrival_ns=arrival_ns, stamp_ns=stamp_ns, candidate=candidate, new_segment=is_new
            )

    def _seen_anew(self, candidate: OdometryKeyframe, lap_ns: int, is_begun: bool) -> OdometryKeyframe:
        """Return the candidate with a noisier image, `lap_ns` later; the start of a segment if none is
        begun."""
        image, pixels = candidate.image, decompress(candidate.image, self.hello.rig.cam0)
        if pixels is not None:
            noise = self._rng.standard_normal(pixels.shape, np.float32)
            pixels = (pixels + _GRAY * noise).clip(0, 255).astype(np.uint8)
            surfaces = (x.astype(np.float64) for x in (image.uv, image.plane, image.rho_sigma))
            image = Surfaces(*surfaces).with_image(pixels)
        if not is_begun:
            return replace(
                candidate,
                image=image,
                new_segment=True,
                T_previous_body=candidate.T_odom_body,
                earlier=EarlierPoses.empty(),
            )
        earlier = replace(candidate.earlier, ids=candidate.earlier.ids + lap_ns)
        return replace(candidate, image=image, earlier=earlier)
