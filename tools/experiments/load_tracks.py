"""Many agents from a few recorded ones: they walk the same tracks, each from another start.

Every image is that of the track with more noise, and every inverse depth with another error, so that no two
are equal; odometry is drawn for each agent. At the end of a track the agent starts it again as a new odometry
segment.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from keyframe_odometry import Drift, odometry
from keyframe_set import AgentKeyframes, KeyframeSet, keyframe_set

from share.geometry import se3
from share.geometry.camera import rays
from share.lab.emulate.recipe import SessionRecipe
from share.types import F64, I64, Keyframe, KeyframeImage, View
from share.vision.keyframe_images import Surfaces, decompress
from share.wire.messages import Hello

RATE_HZ = 3.0  # of keyframes
_GRAY = 3.0  # gray levels, standard deviation of a pixel
_INVERSE_DEPTH = 0.003  # 1/m, standard deviation of inverse depths
_FIRST_NS = 1_000_000_000


class Walker:
    """An agent without end. index: decides its run id and all random numbers."""

    def __init__(self, made: KeyframeSet, index: int) -> None:
        tracks = list(made.agents.values())
        self._track: AgentKeyframes = tracks[index % len(tracks)]
        self._rng = np.random.default_rng((index, 6))
        hello = self._track.hello
        self.hello = Hello(f"agent{index}", hello.kind, int(self._rng.integers(2**63)), hello.rig)

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield its keyframes at `RATE_HZ`."""
        number, first = 0, int(self._rng.integers(len(self._track.keyframes)))
        while True:
            at = np.arange(first, len(self._track.keyframes))
            yield from self._lap(number, at)
            number, first = number + len(at), 0

    def _lap(self, number: int, at: I64) -> Iterator[Keyframe]:
        """Yield keyframes `at` of the track as one segment, with ids from `number` on."""
        stamps_ns = _FIRST_NS + ((number + np.arange(len(at))) * (1e9 / RATE_HZ)).astype(np.int64)
        T, cov = odometry(self._track.T_world_body[at], stamps_ns, self._rng, Drift())
        for k, source in enumerate(at.tolist()):
            yield Keyframe(
                number + k,
                number + k - 1 if k else -1,
                int(stamps_ns[k]),
                se3.inverse(T[k - 1]) @ T[k] if k else T[k],
                cov[k],
                T[k],
                _up(T[k]),
                Drift().tilt_rad,
                View.empty(),
                number + k - 1,
                self._seen_anew(self._track.keyframes[source].image),
            )

    def _seen_anew(self, image: KeyframeImage) -> KeyframeImage:
        rng = self._rng
        rho = (rays(image.uv) * image.plane).sum(axis=1, keepdims=True)
        factor = np.maximum(rho + rng.normal(0, _INVERSE_DEPTH, rho.shape), 1e-3) / rho
        pixels = decompress(image, self.hello.rig.cam0)
        if pixels is not None:
            pixels = (pixels + rng.normal(0, _GRAY, pixels.shape)).clip(0, 255).astype(np.uint8)
        return Surfaces(image.uv, image.plane * factor, image.rho_sigma).with_image(pixels)


def _up(T_odom_body: F64) -> F64:
    """Return the up direction in the body frame."""
    return T_odom_body[2, :3]


RECIPE = SessionRecipe("warehouse", ("ar1=walk:", "ar2=walk:", "robot=robot:"), 60.0, seed=301)


def room() -> KeyframeSet:
    """Return the set; making it takes a minute."""
    return keyframe_set(RECIPE)
