"""Images of keyframes: compressed, checked before they are decoded, and their surfaces."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from share.geometry.camera import Camera
from share.types import (
    MAX_JPEG_BYTES,
    MAX_PLANE,
    MAX_SURFACES,
    MAX_UV,
    KeyframeImage,
    OdometryKeyframe,
    View,
)
from share.vision.image_codec import encode_jpeg, encode_png
from share.vision.keyframe_images import (
    Surfaces,
    capture_decoder_warnings,
    compress,
    decompress,
    image_objection,
    with_less_quality,
)

CAMERA = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)


def picture(detail_px: int = 16) -> np.ndarray:
    rng = np.random.default_rng(1)
    small = rng.integers(0, 256, (480 // detail_px, 640 // detail_px), np.uint8)
    return cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC)


def of_jpeg(data: bytes | np.ndarray) -> KeyframeImage:
    jpeg = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data
    return replace(KeyframeImage.empty(), jpeg=jpeg)


def surfaces(
    uv: object = ((0.1, 0.2),), plane: object = ((0.0, 0.1, 0.5),), sigma: object = (0.01,)
) -> Surfaces:
    return Surfaces(*(np.array(values, np.float64) for values in (uv, plane, sigma)))


# ---------------------------------------------------------------- the type and its limits


def image_of(n: int = 2, **changed: object) -> KeyframeImage:
    fields = {
        "jpeg": np.zeros(3, np.uint8),
        "uv": np.full((n, 2), 0.1),
        "plane": np.full((n, 3), 0.2),
        "rho_sigma": np.full(n, 0.01),
    }
    return KeyframeImage(**(fields | changed))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"jpeg": np.zeros(MAX_JPEG_BYTES + 1, np.uint8)}, "jpeg: 64001 bytes, at most 64000"),
        ({"jpeg": np.zeros((2, 2), np.uint8)}, "jpeg: shape"),
        ({"uv": np.zeros((MAX_SURFACES + 1, 2))}, "uv: 257 features, at most 256"),
        ({"uv": np.zeros((3, 2))}, "plane: shape"),
        ({"plane": np.zeros((1, 3))}, "plane: shape"),
        ({"rho_sigma": np.zeros(1)}, "rho_sigma: shape"),
        ({"uv": np.full((2, 2), 1.01 * MAX_UV)}, "uv: values beyond 1000"),
        ({"plane": np.full((2, 3), -1.01 * MAX_PLANE)}, "plane: values beyond 1000"),
        ({"plane": np.full((2, 3), np.nan)}, "plane: has values that are not finite"),
        ({"rho_sigma": np.full(2, np.nan)}, "rho_sigma: has values that are not finite"),
        ({"rho_sigma": np.full(2, -1e-9)}, "rho_sigma: outside 0"),
        ({"rho_sigma": np.full(2, 2e6)}, "rho_sigma: outside 0"),
    ],
)
def test_a_keyframe_image_has_limits(changed: dict, said: str) -> None:
    image_of()
    with pytest.raises(ValueError, match=said):
        image_of(**changed)


def test_a_keyframe_image_is_read_only_and_keeps_its_types() -> None:
    image = image_of()
    for name, dtype in (
        ("jpeg", np.uint8),
        ("uv", np.float32),
        ("plane", np.float32),
        ("rho_sigma", np.float32),
    ):
        values = getattr(image, name)
        assert values.dtype == dtype and not values.flags.writeable
    assert len(image.without_jpeg().jpeg) == 0 and image.without_jpeg().plane is not None
    assert len(KeyframeImage.empty().points) == len(KeyframeImage.empty().jpeg) == 0


def test_points_lie_on_their_planes() -> None:
    """Behind the camera, or without depth, they are unknown."""
    plane = np.array([[0.1, -0.2, 0.5], [0.0, 0.0, -0.5], [0.0, 0.0, 0.0]])
    points = image_of(3, plane=plane, uv=[[0.3, -0.1], [0.0, 0.1], [0.1, 0.0]]).points
    assert points[0] @ plane[0] == pytest.approx(1, rel=1e-5)
    np.testing.assert_allclose(points[0, :2] / points[0, 2], [0.3, -0.1], rtol=1e-5)
    assert np.isnan(points[1:]).all()


def test_a_candidates_points_are_those_of_its_features_and_surfaces() -> None:
    view = View([[0.0, 0.0]], [[0.0, 0.0, 2.0]], np.zeros((1, 32), np.uint8))
    eye, image = np.eye(4), image_of(1, uv=[[0.0, 0.0]], plane=[[0.0, 0.0, 0.25]])
    candidate = OdometryKeyframe(eye, eye, np.zeros((6, 6)), np.zeros(3), 0.0, view, image=image)
    assert candidate.points[:, 2].tolist() == [2.0, 4.0]


def test_surfaces_that_a_keyframe_cannot_carry_are_not_valid() -> None:
    rho = (0.0, 0.0, 0.5)
    uv = [(0.1, 0.2), (1.01 * MAX_UV, 0.0), (0.1, 0.2), (0.1, 0.2), (0.1, 0.2), (0.1, 0.2)]
    plane = [rho, rho, (0.0, 0.0, 2 * MAX_PLANE), (0.0, 0.0, -0.5), rho, (np.nan, 0.0, 0.5)]
    sigma = [0.01, 0.01, 0.01, 0.01, 2e6, 0.01]
    found = surfaces(uv, plane, sigma)
    assert found.is_valid().tolist() == [True, False, False, False, False, False]
    image = found.take(found.is_valid()).with_image(None)
    assert len(image.jpeg) == 0 and image.uv.tolist() == [pytest.approx([0.1, 0.2])]


# ---------------------------------------------------------------- compressed and decoded


def test_an_image_survives_compression() -> None:
    image = surfaces().with_image(picture())
    assert 0 < len(image.jpeg) < 25_000
    decoded = decompress(image, CAMERA)
    assert decoded is not None and decoded.dtype == np.uint8
    assert np.abs(decoded.astype(float) - picture()).mean() < 3
    assert image_objection(image, CAMERA) is None


def test_a_small_picture_is_the_same_view_in_fewer_bytes() -> None:
    shown = picture()
    full = replace(image_of(), jpeg=compress(shown))
    small = with_less_quality(full, 20)
    assert len(small.jpeg) < 0.7 * len(full.jpeg) and image_objection(small, CAMERA) is None
    decoded = decompress(small, CAMERA)
    assert decoded is not None and np.abs(decoded.astype(int) - shown).mean() < 6
    assert np.array_equal(small.uv, full.uv) and np.array_equal(small.rho_sigma, full.rho_sigma)


def test_compressing_again_keeps_what_it_cannot_make_smaller() -> None:
    full = replace(image_of(), jpeg=compress(picture()))
    for image in (KeyframeImage.empty(), image_of(), with_less_quality(full, 20)):
        assert with_less_quality(image, 95) is image


def test_an_image_of_noise_is_compressed_more_and_one_that_never_fits_is_left_out() -> None:
    noise = np.random.default_rng(2).integers(0, 256, (480, 640), np.uint8)
    assert len(encode_jpeg(noise, 50)) > MAX_JPEG_BYTES
    assert 0 < len(compress(noise)) <= MAX_JPEG_BYTES
    assert len(compress(np.tile(noise, (3, 3)))) == 0


def huge(jpeg: bytes) -> bytes:
    """The same with a header that states 65500x65500 px."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + (65_500).to_bytes(2, "big") * 2 + jpeg[at + 4 :]


def progressive() -> bytes:
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    return bytes(cv2.imencode(".jpg", picture(), options)[1])


JPEG = encode_jpeg(picture(), 50)
BAD = {
    "its image has 65500x65500 px, its camera 640x480": huge(JPEG),
    "its image has 648x480 px, its camera 640x480": encode_jpeg(np.zeros((480, 648), np.uint8), 50),
    "its image has 480x640 px, its camera 640x480": encode_jpeg(picture().T.copy(), 50),
    "its image is no baseline JPEG": progressive(),
    "its image is no JPEG, or cut short": JPEG[: len(JPEG) // 2],
}


@pytest.mark.parametrize("said", BAD)
def test_an_image_that_cannot_be_the_cameras_is_named_and_not_decoded(
    said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = of_jpeg(BAD[said])
    assert image_objection(image, CAMERA) == said
    monkeypatch.setattr(cv2, "imdecode", None)
    assert decompress(image, CAMERA) is None


def test_other_bytes_are_no_image() -> None:
    rng = np.random.default_rng(3)
    for data in (b"\0", b"\xff\xd8", rng.bytes(900), JPEG[::-1], b"\xff\xd8" + rng.bytes(900) + b"\xff\xd9"):
        assert image_objection(of_jpeg(data), CAMERA) == "its image is no JPEG, or cut short"
        assert decompress(of_jpeg(data), CAMERA) is None
    blank = np.zeros((480, 640), np.uint8)
    assert image_objection(of_jpeg(encode_png(blank)), CAMERA) == "its image is no baseline JPEG"
    assert image_objection(KeyframeImage.empty(), CAMERA) is None
    assert decompress(KeyframeImage.empty(), CAMERA) is None


def test_no_damaged_image_raises() -> None:
    """Decoding gives an image of the camera's size, or none."""
    rng, sizes = np.random.default_rng(4), set()
    jpeg = np.frombuffer(JPEG, np.uint8)
    for _ in range(60):
        damaged = jpeg.copy()
        damaged[rng.integers(0, len(jpeg), rng.integers(1, 6))] = rng.integers(0, 256)
        decoded = decompress(of_jpeg(damaged), CAMERA)
        sizes.add(None if decoded is None else decoded.shape)
    assert sizes <= {None, (480, 640)} and (480, 640) in sizes


def test_an_image_larger_than_any_edge_bears_is_left_out() -> None:
    """libjpeg would fill 8192 x 8192 px of an 11 kB file."""
    large = Camera(8192, 8192, 4000, 4000, 4096, 4096)
    assert not len(compress(np.zeros((8192, 8192), np.uint8)))
    jpeg = encode_jpeg(np.zeros((2000, 2000), np.uint8), 10)
    said = image_objection(of_jpeg(np.frombuffer(jpeg, np.uint8)), Camera(2000, 2000, 900, 900, 1000, 1000))
    assert said is not None and "more than 2400000" in said
    assert decompress(of_jpeg(np.frombuffer(jpeg, np.uint8)), large) is None


def filled_up() -> np.ndarray:
    """A JPEG whose end is missing in the middle of the pixels: libjpeg fills the rest with gray."""
    return np.frombuffer(JPEG[: len(JPEG) // 2] + b"\xff\xd9", np.uint8)


def test_what_libjpeg_fills_up_is_damaged_and_nothing_is_written_to_stderr(
    capfd: pytest.CaptureFixture[str],
) -> None:
    image = of_jpeg(filled_up())
    assert image_objection(image, CAMERA) is None
    assert cv2.imdecode(filled_up(), cv2.IMREAD_GRAYSCALE).shape == (480, 640)
    assert "Corrupt JPEG data" in capfd.readouterr().err
    assert decompress(image, CAMERA) is None
    assert decompress(of_jpeg(JPEG), CAMERA) is not None
    assert capfd.readouterr().err == ""


def test_stderr_is_as_it_was_after_a_decoder_fails(capfd: pytest.CaptureFixture[str]) -> None:
    def fails() -> None:
        os.write(2, b"lost")
        raise ValueError("no image")

    with pytest.raises(ValueError, match="no image"):
        capture_decoder_warnings(fails)
    os.write(2, b"seen")
    assert capture_decoder_warnings(lambda: os.write(2, b"noticed")) == (7, "noticed")
    assert capfd.readouterr().err == "seen"


def test_images_are_decoded_by_several_threads_at_once() -> None:
    images = [of_jpeg(JPEG), of_jpeg(filled_up())] * 20
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda image: decompress(image, CAMERA) is not None, images))
    assert found == [True, False] * 20
    assert len(os.listdir("/proc/self/fd")) < 200


def test_an_image_is_decoded_without_a_stderr() -> None:
    code = (
        "import numpy as np; from share.vision.keyframe_images import capture_decoder_warnings;"
        "print(capture_decoder_warnings(lambda: 5))"
    )
    done = subprocess.run(["/bin/sh", "-c", f"exec {sys.executable} -c '{code}' 2>&-"], capture_output=True)
    assert done.stdout.strip() == b"(5, '')"
