"""A COLMAP text model (https://colmap.github.io/format.html): sparse/0/*.txt and images/.

Nerfstudio, gsplat and pycolmap open the folder as it is. COLMAP's pixels are half a pixel off ours: the
centre of its top-left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from share.errors import DataError, UsageError
from share.files.writing import open_new, write_errors
from share.geometry import se3
from share.geometry.camera import Camera
from share.recordings.exports.names import plain_names
from share.recordings.exports.scene import Progress, Scene, SceneView
from share.types import F64
from share.vision.image_codec import decode_gray, image_header

_SHIFT_PX = 0.5
_NO_ERROR_PX = 0.0  # of a point: it is seen by one picture, and lies on its ray


def write_colmap(scene: Scene, folder: Path, progress: Progress) -> None:
    """Write the keyframes of `scene` that have a picture, with their points, to the existing `folder`.

    progress: called with 1 for each keyframe. Raises UsageError if none has one, ShareError.
    """
    names = plain_names(list(scene.agents))
    numbers = {name: number for number, name in enumerate(names, start=1)}
    model, pictures = folder / "sparse" / "0", folder / "images"
    for made in (model, pictures):
        made.mkdir(parents=True)
    with (
        write_errors(model),
        open_new(model / "cameras.txt") as cameras,
        open_new(model / "images.txt") as images,
        open_new(model / "points3D.txt") as points,
    ):
        for name, agent in scene.agents.items():
            if agent.rig is not None:
                cameras.write(_camera_line(numbers[name], agent.rig.cam0).encode())
        image_count = point_count = 0
        for view in scene.views:
            progress(1)
            jpeg, camera = view.jpeg(), scene.camera(view)
            if camera is None or not _is_of(jpeg, camera):
                continue
            image_count += 1
            file_name = f"{names[view.agent]}_{view.number:06d}.jpg"
            with open_new(pictures / file_name) as picture:
                picture.write(jpeg)
            pixels = camera.project(view.points)
            inside = camera.is_inside(pixels)
            ids = point_count + 1 + np.arange(int(inside.sum()))
            point_count += len(ids)
            images.write(
                _image_lines(image_count, scene, view, numbers, file_name, pixels[inside], ids).encode()
            )
            colours = _gray_values(jpeg, pixels[inside], str(pictures / file_name))
            lines = _point_lines(ids, scene.world_points(view)[inside], colours, image_count)
            points.write(lines.encode())
    if not image_count:
        raise UsageError(f"{scene.name}: has no pictures, which a COLMAP model consists of")


def _is_of(jpeg: bytes, camera: Camera) -> bool:
    """Return whether a picture has the camera's size; one that is missing or damaged has not."""
    header = image_header(jpeg)
    return header is not None and (header.width, header.height) == (camera.width, camera.height)


def _camera_line(number: int, camera: Camera) -> str:
    """Return a line of cameras.txt: number, model, size, parameters."""
    d = camera.distortion
    if camera.is_fisheye:
        model, rest = "OPENCV_FISHEYE", d
    elif not d:
        model, rest = "PINHOLE", ()
    elif len(d) == 4:
        model, rest = "OPENCV", d
    else:
        model, rest = "FULL_OPENCV", (*d, 0.0, 0.0, 0.0)
    values = (camera.fx, camera.fy, camera.cx + _SHIFT_PX, camera.cy + _SHIFT_PX, *rest)
    return f"{number} {model} {camera.width} {camera.height} {' '.join(repr(float(v)) for v in values)}\n"


def _image_lines(
    number: int,
    scene: Scene,
    view: SceneView,
    cameras: dict[str, int],
    file_name: str,
    pixels: F64,
    ids: np.ndarray,
) -> str:
    """Return the two lines of an image: T_cam_world, camera, name; then x, y and point of each feature."""
    T_cam_world = se3.inverse(scene.T_world_cam0(view))
    x, y, z, w = se3.quat_from_matrix(T_cam_world[:3, :3]).tolist()
    pose = " ".join(f"{value:.12g}" for value in (w, x, y, z, *T_cam_world[:3, 3].tolist()))
    features = " ".join(
        f"{u:.3f} {v:.3f} {point}" for (u, v), point in zip(pixels + _SHIFT_PX, ids.tolist(), strict=True)
    )
    return f"{number} {pose} {cameras[view.agent]} {file_name}\n{features}\n"


def _point_lines(ids: np.ndarray, points: F64, gray: Sequence[int], image: int) -> str:
    """Return the lines of points3D.txt: number, position, colour, error, and the feature that it is."""
    rows = zip(ids.tolist(), points.tolist(), gray, strict=True)
    return "".join(
        f"{number} {x:.6f} {y:.6f} {z:.6f} {g} {g} {g} {_NO_ERROR_PX} {image} {feature}\n"
        for feature, (number, (x, y, z), g) in enumerate(rows)
    )


def _gray_values(jpeg: bytes, pixels: F64, where: str) -> list[int]:
    try:
        image = decode_gray(jpeg, where)
    except DataError:
        return [128] * len(pixels)
    columns, rows = np.rint(pixels).astype(int).T.reshape(2, -1)
    in_image = (rows < image.shape[0]) & (columns < image.shape[1])
    out = np.full(len(pixels), 128)
    out[in_image] = image[rows[in_image], columns[in_image]]
    return [int(value) for value in out]
