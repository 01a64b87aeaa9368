"""Geometry of drawn images: projected points, exact depth, tracks, moving parts; determinism."""

import cv2
import numpy as np
import pytest
from helpers.rendered import (
    D435I,
    EUROC,
    OFF_CENTRE,
    SIZE,
    box,
    checker,
    furnished,
    looking,
    needs_opengl,
    plain,
)

from share.geometry.camera import Camera, rays
from share.geometry.se3 import inverse, transform
from share.lab.emulate.render.gl import GlRenderer
from share.lab.emulate.types import SceneInstant

pytestmark = [pytest.mark.long, needs_opengl]
CAMERAS = pytest.mark.parametrize("camera", [D435I, OFF_CENTRE, EUROC], ids=["d435i", "off-centre", "euroc"])


@pytest.fixture(scope="module")
def boxes():
    return GlRenderer(furnished())


@pytest.fixture(scope="module")
def again():
    """Another renderer of the same."""
    return GlRenderer(furnished())


def halved(camera):
    """The same view with a quarter of the pixels."""
    K = camera.fx / 2, camera.fy / 2, (camera.cx - 0.5) / 2, (camera.cy - 0.5) / 2
    return Camera(camera.width // 2, camera.height // 2, *K, camera.distortion)


def exact_depth(mesh, camera, T_world_cam):
    """Depth of the nearest triangle on every pixel's ray, by brute force in double precision; and whether
    the ray clears the sides of all triangles by the 1/256 px that OpenGL rounds corners to."""
    px = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).reshape(-1, 2)
    every = rays(camera.normalise(px.astype(float)))
    x, y = np.ascontiguousarray((every[:, :2] / every[:, 2:]).T)
    best, clear = np.zeros(len(every)), np.ones(len(every), bool)
    for corners in mesh.triangles.astype(float):
        p = transform(inverse(T_world_cam), corners)
        if (p[:, 2] < 0).all():
            continue
        here = np.arange(len(every))
        if (p[:, 2] > 0.01).all():  # only the rays near it
            (left, top), (right, bottom) = (f(p[:, :2] / p[:, 2:], axis=0) for f in (np.min, np.max))
            here = here[(x > left - 0.01) & (x < right + 0.01) & (y > top - 0.01) & (y < bottom + 0.01)]
        r = every[here]
        normal = np.cross(p[1] - p[0], p[2] - p[0])
        q = r @ normal / (normal @ p[0])
        sides = np.stack([r @ (e / np.linalg.norm(e)) for e in (np.cross(p[i], p[i - 2]) for i in range(3))])
        inner = np.maximum(sides.min(0, initial=np.inf), -sides.max(0, initial=-np.inf))
        best[here] = np.where((inner > 0) & (q > best[here]), q, best[here])
        clear[here] &= np.abs(inner) > 1.5e-5
    return (1 / best).reshape(camera.height, -1), clear.reshape(camera.height, -1)


@CAMERAS
def test_corners_are_where_they_project(camera):
    renderer, errors, edges = GlRenderer(plain(checker())), [], []
    for k in range(6):
        T = looking(0.4 + 1.1 * k, 0.15 * (k % 3 - 1), (4.1 + 0.1 * k, 2.9, 1.7))
        image = renderer.radiance(camera, [SceneInstant(T)])
        px = camera.project(transform(inverse(T), corners_of_walls(camera, T)))
        px = px[camera.is_inside(px, 9)]
        found = saddles(image, px)
        ok = ~np.isnan(found[:, 0])
        errors.append((found - px)[ok])
        edges.append(~camera.is_inside(px[ok], 60))
    error, edge = np.concatenate(errors), np.concatenate(edges)
    assert len(error) > 60 and edge.sum() > 15
    assert np.sqrt((error**2).sum(1).mean()) < 0.05
    assert np.sqrt((error[edge] ** 2).sum(1).mean()) < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.01  # no shift in common: pixel centres are at integers


def corners_of_walls(camera, T):
    """Corners of the checkerboard, on walls seen not too obliquely and large enough to be found."""
    out = []
    for axis in range(3):
        along, across = (axis + 1) % 3, (axis + 2) % 3
        for at in (0.0, SIZE[axis]):
            s, t = np.meshgrid(np.arange(1, SIZE[along] * 4) / 4, np.arange(1, SIZE[across] * 4) / 4)
            p = np.empty((s.size, 3))
            p[:, axis], p[:, along], p[:, across] = at, s.ravel(), t.ravel()
            seen = p - T[:3, 3]
            far = np.linalg.norm(seen, axis=1)
            slant = np.abs(seen[:, axis]) / far
            out.append(p[(slant > 0.6) & (0.25 * camera.fx * slant / far > 18)])
    return np.concatenate(out)


def saddles(image, px):
    """The saddle point of the brightness near each of px (N, 2): a quadratic fitted to a smoothed patch,
    started again from where it was. NaN where it runs away."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.5)
    grid = np.arange(-3.0, 4.0)
    x, y = (g.ravel() for g in np.meshgrid(grid, grid))
    basis = np.linalg.pinv(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1))
    out = px.copy()
    for _ in range(6):
        for i, (u, v) in enumerate(out):
            if np.isnan(u) or abs(out[i] - px[i]).max() > 2:
                out[i] = np.nan
                continue
            patch = cv2.getRectSubPix(smooth, (7, 7), (float(u), float(v)))
            a, b, c, d, e, _ = basis @ patch.ravel()
            out[i] += np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])
    return out


@CAMERAS
def test_depth_is_exact(camera):
    room, camera = furnished(30), camera if camera.distortion else halved(camera)
    renderer = GlRenderer(room)
    for yaw, pitch in ((0.3, 0.2), (3.6, -0.3)):
        T = looking(yaw, pitch)
        depth = renderer.depth(camera, SceneInstant(T))
        exact, clear = exact_depth(room.mesh, camera, T)
        wrong = np.abs(depth - exact)[clear] > 1e-5
        assert clear.mean() > 0.999
        assert wrong.mean() <= (2e-5 if camera.distortion else 0)  # a lens may miss a sliver of a face


def test_nothing_has_no_depth(boxes):
    outside = looking(0.0, 0.0, (40.0, 3.0, 1.6))
    assert not boxes.depth(D435I, SceneInstant(outside)).any()
    assert not boxes.depth(EUROC, SceneInstant(outside)).any()
    assert not boxes.radiance(D435I, [SceneInstant(outside)]).any()


@CAMERAS
def test_drawing_is_deterministic(camera, boxes, again):
    moments = [SceneInstant(looking(0.1 + 0.01 * k)) for k in range(4)]
    for shot in (moments[:1], moments):
        first = boxes.radiance(camera, shot)
        boxes.radiance(OFF_CENTRE, moments[1:2])  # another size in between
        assert first.tobytes() == boxes.radiance(camera, shot).tobytes()
        assert first.tobytes() == again.radiance(camera, shot).tobytes()
    assert boxes.depth(camera, moments[0]).tobytes() == again.depth(camera, moments[0]).tobytes()


@pytest.mark.parametrize(
    "camera", [D435I, pytest.param(EUROC, marks=pytest.mark.slow)], ids=["d435i", "euroc"]
)
def test_tracks_follow_the_scene(camera):
    renderer, errors = GlRenderer(furnished(60)), []
    for k in range(6):
        T0, T1 = looking(0.9 * k, 0.05), looking(0.9 * k + 0.02, 0.06, (4.53, 3.02, 1.59))
        before, after = (to_bytes(renderer.radiance(camera, [SceneInstant(T)])) for T in (T0, T1))
        px = cv2.goodFeaturesToTrack(before, 200, 0.01, 12).reshape(-1, 2)
        depth = renderer.depth(camera, SceneInstant(T0))
        z = depth[px[:, 1].astype(int), px[:, 0].astype(int)].astype(float)
        points = rays(camera.normalise(px.astype(float))) * z[:, None]
        true = camera.project(transform(inverse(T1) @ T0, points))
        ok = smooth_around(depth, px) & camera.is_inside(true, 15)
        found = track(before, after, px[ok], true[ok])
        errors.append(np.linalg.norm(found - true[ok], axis=1))
    error = np.concatenate(errors)
    assert len(error) > 400
    assert np.median(error) < 0.03


def to_bytes(image):
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def smooth_around(depth, px, half=11):
    """Where all is one surface: no track can tell foreground from background at an edge."""
    jump = np.abs(cv2.Laplacian(1 / depth, cv2.CV_32F)) > 1e-3
    near = cv2.dilate(jump.astype(np.uint8), np.ones((2 * half + 1,) * 2, np.uint8))
    return near[px[:, 1].astype(int), px[:, 0].astype(int)] == 0


def track(before, after, px, start):
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    guess = start.astype(np.float32).reshape(-1, 1, 2)
    out, _, _ = cv2.calcOpticalFlowPyrLK(
        before, after, px.reshape(-1, 1, 2), guess, winSize=(21, 21), maxLevel=0, criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return out.reshape(-1, 2)


@pytest.mark.parametrize("camera", [D435I, EUROC], ids=["d435i", "euroc"])
def test_moving_parts_are_drawn_at_their_poses(camera):
    cube = box(np.full(3, -0.2), np.full(3, 0.2), 0)
    gray = np.full((64, 64), 40, np.uint8)
    renderer = GlRenderer(plain(gray, {"someone": (cube, cube)}))
    T = looking(0.0)
    seen, hidden = np.eye(4), np.eye(4)
    seen[:3, 3] = T[:3, 3] + (2.2, 0.3, -0.2)
    hidden[:3, 3] = T[:3, 3] + (4.0, 0.55, -0.36)  # behind the other, and smaller
    alone, both = (SceneInstant(T, {"someone": np.stack(parts)}) for parts in ((seen, seen), (seen, hidden)))
    empty, one, two = (renderer.depth(camera, m) for m in (SceneInstant(T), alone, both))
    assert (one == two).all()
    u, v = camera.project(transform(inverse(T), seen[None, :3, 3] - (0.2, 0, 0)))[0].round().astype(int)
    assert one[v, u] == pytest.approx(2.0, abs=1e-6) and empty[v, u] == pytest.approx(4.5, abs=1e-6)
    changed = one != empty
    corners = seen[:3, 3] + np.array(
        [[x, y, z] for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.2, 0.2)]
    )
    hull = cv2.convexHull(camera.project(transform(inverse(T), corners)).astype(np.float32))
    ys, xs = np.nonzero(cv2.dilate(changed.astype(np.uint8), np.ones((3, 3))))
    side = np.array(
        [cv2.pointPolygonTest(hull, (float(x), float(y)), True) for x, y in zip(xs, ys, strict=True)]
    )
    assert (changed[ys, xs] == (side > 0))[np.abs(side) > 0.6].all()
    images = [renderer.radiance(camera, [m]) for m in (SceneInstant(T), alone, both)]
    assert np.array_equal(images[1], images[2])
    assert np.abs(images[1] - images[0])[cv2.erode(changed.astype(np.uint8), np.ones((3, 3))) == 1].min() > 1
    outside = cv2.dilate(changed.astype(np.uint8), np.ones((5, 5))) == 0
    assert np.array_equal(images[1][outside], images[0][outside])


def test_a_box_hides_a_mover():
    cube = box(np.full(3, -0.1), np.full(3, 0.1), 0)
    room = furnished(movers={"someone": (cube,)})
    renderer, T = GlRenderer(room), looking(1.0)
    behind = np.eye(4)
    behind[:3, 3] = T[:3, 3] + 30 * T[:3, 2]  # beyond the wall
    for moment in (SceneInstant(T, {"someone": behind[None]}), SceneInstant(T)):
        assert np.array_equal(renderer.depth(D435I, moment), renderer.depth(D435I, SceneInstant(T)))
        assert np.array_equal(renderer.radiance(D435I, [moment]), renderer.radiance(D435I, [SceneInstant(T)]))
