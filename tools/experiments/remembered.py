"""A mapper that verifies each pair of views once over many runs, and records contradictions between
agents."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from typing import Any

from share.config import Config
from share.mapping.corrections import MapEvent
from share.mapping.mapper import Mapper
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView, Refusal, Verification
from share.mapping.steps import LookupStep, Step, VerifyStep
from share.wire.messages import Hello

_seen: dict[tuple[bytes, bytes], Verification | Refusal] = {}


class _Remembered(VerifyStep):
    """A verification step; its result depends on the two views and images alone."""

    def run(self) -> Verification | Refusal:
        query = _digest(self.query_view, self.query_image)
        key = query, _digest(self.candidate_view, self.candidate_image)
        if key not in _seen:
            _seen[key] = super().run()
        return _seen[key]


class RememberingMapper(Mapper):
    """runs: run ids by agents' names."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.runs: dict[str, str] = {}
        self._doubts: dict[frozenset[str], float] = {}  # largest so far
        self._were_apart: set[frozenset[str]] = set()  # separated at any time

    def add_run(self, agent: str, hello: Hello) -> None:
        self.runs[hello.name] = agent
        super().add_run(agent, hello)

    def next_lookup(self) -> LookupStep | None:
        look = super().next_lookup()
        if not isinstance(look, VerifyStep):
            return look
        views = look.query_view, look.candidate_id, look.candidate_view
        return _Remembered(look.node_id, *views, look.query_image, look.candidate_image)

    def finish_step(self, step: Step, result: Any, ms: float) -> list[MapEvent]:
        map_events = super().finish_step(step, result, ms)
        if isinstance(step, VerifyStep):
            self._note_standing()
        return map_events

    def doubt(self, of: Collection[str]) -> float:
        """Return the largest contradiction ever between two of these."""
        return max((doubt for pair, doubt in self._doubts.items() if pair <= set(of)), default=0.0)

    def wronged(self, honest: Collection[str]) -> bool:
        """Return whether two of these were ever separated."""
        return any(pair <= set(honest) for pair in self._were_apart)

    def _note_standing(self) -> None:
        for names, doubt in self.atlas.quarantine.agreement.contradictions().items():
            pair = frozenset(names)
            self._doubts[pair] = max(doubt, self._doubts.get(pair, 0.0))
            if self.atlas.quarantine.agreement.are_separated(*names):
                self._were_apart.add(pair)


def _digest(sight: CameraView, image: ImageView | None) -> bytes:
    view, made = sight.view, hashlib.blake2b(digest_size=16)
    of_image = () if image is None else (image.source.jpeg, image.source.plane)
    for array in (view.uv, view.points, view.descriptors, sight.T_body_cam0, sight.up, *of_image):
        made.update(array.tobytes())
    made.update(repr(sight.focal).encode())
    return made.digest()
