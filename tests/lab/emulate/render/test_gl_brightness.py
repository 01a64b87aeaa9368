"""Brightness of drawn images: gray levels, light, filters, motion blur, shading of moving parts."""

import numpy as np
import pytest
from helpers.rendered import D435I, EUROC, SIZE, box, checker, furnished, looking, needs_opengl, plain

from share.geometry.camera import Camera
from share.lab.emulate.render.gl import GlRenderer
from share.lab.emulate.types import DrawableRoom, SceneInstant

pytestmark = [pytest.mark.long, needs_opengl]


@pytest.fixture(scope="module")
def boxes():
    return GlRenderer(furnished())


def test_gray_level_is_albedo_times_light():
    room = plain(np.full((64, 64), 120, np.uint8))
    for light in (25, 240):
        lit = DrawableRoom(**vars(room) | {"light_map": np.full((4, 4), light, np.uint8)})
        for camera in (D435I, EUROC):
            image = GlRenderer(lit).radiance(camera, [SceneInstant(looking(0.3))])
            assert image.shape == (camera.height, camera.width) and image.dtype == np.float32
            assert (
                np.abs(image - 120 * light / 100).max() < 0.02
            )  # beyond 255 too: what is exposed so is a sensor's


def test_an_image_without_an_instant_is_refused(boxes):
    with pytest.raises(ValueError, match="instants"):
        boxes.radiance(D435I, [])


@pytest.mark.parametrize("camera", [D435I, EUROC], ids=["d435i", "euroc"])
def test_a_fine_pattern_is_not_aliased(camera):
    """Squares far smaller than a pixel are gray, not moire."""
    fine = plain(checker(128))
    small = Camera(
        camera.width // 4, camera.height // 4, camera.fx / 16, camera.fy / 16, camera.cx / 4, camera.cy / 4
    )
    image = GlRenderer(fine).radiance(small, [SceneInstant(looking(0.7))])
    assert np.abs(image - 125).max() < 8  # of a contrast of 75; nearest where most is left
    assert np.abs(image - 125).mean() < 0.3


def blurred(k: int, count: int, speed: float = 0.04):
    """`count` moments in the middles of equal parts of an exposure: a turn of `speed` rad with a shift."""
    at = (np.arange(count) + 0.5) / count - 0.5
    return [
        SceneInstant(looking(0.9 * k + speed * t, 0.1 + 0.3 * speed * t, (4.5 + 0.02 * t, 3.0, 1.6)))
        for t in at
    ]


@pytest.mark.slow
def test_blur_converges(boxes):
    """To the mean of many supersampled moments; 15 px of blur."""
    reference = np.mean([boxes.radiance(D435I, [m]) for m in blurred(0, 64)], axis=0)
    images = {n: boxes.radiance(D435I, blurred(0, n)) for n in (1, 4, 8, 16)}
    rms = {n: float(np.sqrt(np.mean((image - reference) ** 2))) for n, image in images.items()}
    assert rms[1] > 10 and rms[1] > 3 * rms[4] > 4 * rms[8] > 5 * rms[16]
    assert rms[16] < 1.1  # gray levels


def test_blur_through_a_lens(boxes):
    reference = np.mean([boxes.radiance(EUROC, [m]) for m in blurred(0, 12)], axis=0)
    image, sharp = (boxes.radiance(EUROC, blurred(0, n)) for n in (6, 1))
    assert 5 * np.sqrt(np.mean((image - reference) ** 2)) < np.sqrt(np.mean((sharp - reference) ** 2))


def test_a_pixel_is_the_mean_over_its_area(boxes):
    """The more samples, the nearer; three are nearly as good as many."""
    still = SceneInstant(looking(0.5))
    reference = boxes.radiance(D435I, [still] * 64)
    images = {n: boxes.radiance(D435I, [still] * n) for n in (1, 4, 16)}
    rms = {n: float(np.sqrt(np.mean((image - reference) ** 2))) for n, image in images.items()}
    print(rms)
    assert rms[16] < 0.6 * rms[4] < 0.6 * rms[1] < 1.5  # gray levels


def test_moving_parts_are_shaded():
    """A mover's sides differ in brightness, by the world's directions and not by the camera's."""
    cube = box(np.full(3, -0.2), np.full(3, 0.2), 0)
    room = plain(np.full((64, 64), 100, np.uint8), {"someone": (cube,)})
    renderer, levels = GlRenderer(room), {}
    for yaw in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        T = looking(yaw, at=(SIZE[0] / 2, SIZE[1] / 2, 1.0))
        T_world_part = np.eye(4)
        T_world_part[:3, 3] = T[:3, 3] + T[:3, 2]
        image = renderer.radiance(D435I, [SceneInstant(T, {"someone": T_world_part[None]})])
        levels[yaw] = image[242, 319]
        turned = T_world_part.copy()  # the same cube, other corners first
        turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
        assert renderer.radiance(D435I, [SceneInstant(T, {"someone": turned[None]})])[242, 319] == levels[yaw]
    assert min(np.diff(sorted(levels.values()))) > 3
    assert 75 < np.mean(list(levels.values())) < 125
