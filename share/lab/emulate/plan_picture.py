"""The plan of a session: the room and the paths in it, seen from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from share.lab.emulate.stage import Actor
from share.lab.emulate.world.layout import Layout
from share.lab.evaluate.charts import save_png
from share.types import F64

_COLOURS = ("#d1495b", "#00798c", "#edae49", "#66508c", "#3a7d44", "#8d5b4c")
_STEP_NS = 50_000_000
_ARROW_S = 5.0  # between two arrows that show an agent's viewing direction


def draw_plan(path: Path, layout: Layout, actors: tuple[Actor, ...]) -> None:
    """Write a PNG: furniture by its height (darker is higher), paths, and an arrow every few seconds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.collections import PolyCollection

    length, width, height = layout.size
    figure, axes = pyplot.subplots(figsize=(10, 10 * (width + 1.2) / (length + 1)), layout="constrained")
    triangles = _furniture_triangles(layout)
    tops = triangles[:, :, 2].mean(axis=1)
    shades = 0.93 - 0.6 * (tops / height).clip(0, 1)
    axes.add_collection(PolyCollection(list(triangles[:, :, :2]), facecolors=[str(s) for s in shades]))
    axes.add_patch(pyplot.Rectangle((0, 0), length, width, fill=False, linewidth=2))
    for actor, colour in zip(actors, _COLOURS * len(actors), strict=False):
        p, ahead = _camera_path(actor)
        walked_m = np.linalg.norm(np.diff(p, axis=0), axis=1).sum()
        axes.plot(p[:, 0], p[:, 1], color=colour, linewidth=1.3, label=f"{actor.name}, {walked_m:.1f} m")
        axes.plot(*p[0, :2], "o", color=colour)
        every = slice(None, None, max(1, int(_ARROW_S * 1e9 / _STEP_NS)))
        origins, arrows = p[every], 0.3 * ahead[every]
        axes.quiver(
            *origins[:, :2].T,
            *arrows[:, :2].T,
            color=colour,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=3e-3,
        )
    axes.set(
        xlim=(-0.3, length + 0.3), ylim=(-0.3, width + 0.3), xlabel="x [m]", ylabel="y [m]", aspect="equal"
    )
    axes.set_title(f"{layout.name}, seed {layout.seed}, {length:g} x {width:g} x {height:g} m")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=6, frameon=False)
    save_png(figure, path, 100)


def _furniture_triangles(layout: Layout) -> F64:
    """Return triangles (F, 3, 3) of the solid pieces, lowest first."""
    meshes = [piece.shape.mesh.triangles for piece in layout.pieces if piece.solid]
    triangles = np.concatenate([np.zeros((0, 3, 3)), *meshes]).astype(float)
    return triangles[np.argsort(triangles[:, :, 2].max(axis=1), kind="stable")]


def _camera_path(actor: Actor) -> tuple[F64, F64]:
    """Return positions (N, 3) and viewing directions (N, 3) of cam0 along the path."""
    stamps = np.arange(actor.path.start_ns, actor.path.end_ns + 1, _STEP_NS)
    T = actor.path.poses(stamps) @ actor.rig.T_body_cam0
    return T[:, :3, 3], T[:, :3, 2]
