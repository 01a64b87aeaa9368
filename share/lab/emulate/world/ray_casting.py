"""First hits and occlusion of rays: Embree's single-precision ray casting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.errors import UsageError, install_hint
from share.lab.emulate.types import I32
from share.types import F32


class RayCaster:
    """Triangles (F, 3, 3) m to cast rays at. Raises UsageError where Embree is not installed."""

    def __init__(self, triangles: F32) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise UsageError(f"light: {install_hint('embreex', 'emulate')}") from None
        corners = np.ascontiguousarray(triangles.reshape(-1, 3), np.float32)
        self.triangles = triangles
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(
            self._scene, corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        )

    def is_blocked(self, start: F32, segment: F32) -> NDArray[np.bool_]:
        """Return whether anything lies on each segment from `start` (N, 3) to `start + segment`."""
        hit = self._scene.run(start, segment, dists=np.ones(len(start), np.float32), query="OCCLUDED")
        return np.asarray(hit == 0)

    def first_hits(self, start: F32, direction: F32) -> tuple[I32, F32]:
        """Return the triangle (N,) that each ray meets first, -1 for none, and weights (N, 3) of its corners
        at the hit."""
        hit = self._scene.run(start, direction, output=1)
        u, v = hit["u"], hit["v"]
        return hit["primID"], np.stack([1 - u - v, u, v], axis=1)
