"""Intact images decode exactly; others are refused by name."""

import cv2
import numpy as np
import pytest
from helpers.recordings import HEIGHT, WIDTH, depth_mm, picture

from share.errors import DataError
from share.recordings.images import EncodedImage
from share.vision.image_codec import decode_gray


def encoded(extension: str, image: np.ndarray, scale: float = 0.0, width: int = WIDTH) -> EncodedImage:
    data = cv2.imencode(extension, image)[1].tobytes()
    return EncodedImage(data, "picture", width, HEIGHT, scale)


def test_gray_png_is_exact_and_colour_becomes_gray():
    np.testing.assert_array_equal(encoded(".png", picture(1)).load(), picture(1))
    colour = encoded(".png", picture(1, 3)).load()
    assert colour.shape == (HEIGHT, WIDTH)
    assert np.abs(colour - cv2.cvtColor(picture(1, 3), cv2.COLOR_BGR2GRAY).astype(int)).max() <= 1


def test_depth_is_in_metres_and_zero_stays_zero():
    mm = depth_mm(0)
    mm[0, 0] = 0
    depth = encoded(".png", mm, 1000.0).load()
    assert depth.dtype == np.float32
    assert depth[0, 0] == 0
    np.testing.assert_allclose(depth, mm / 1000, atol=1e-6)


@pytest.mark.parametrize("extension", [".jpg", ".png"])
@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 0.99])
def test_a_cut_image_is_refused(extension, part):
    data = cv2.imencode(extension, picture(2))[1].tobytes()
    image = EncodedImage(data[: int(len(data) * part)], "cut", WIDTH, HEIGHT)
    with pytest.raises(DataError, match=r"cut: .*(cut short|empty|neither)"):
        image.load()


def test_a_flipped_bit_in_a_png_is_refused():
    data = bytearray(cv2.imencode(".png", depth_mm(3))[1].tobytes())
    data[len(data) // 2] ^= 1
    with pytest.raises(DataError, match="damaged"):
        EncodedImage(bytes(data), "x", WIDTH, HEIGHT, 1000.0).load()


def test_wrong_size_missing_file_8_bit_depth_and_other_formats_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"is 64x48, but the calibration is for 99x48.*--calib"):
        encoded(".png", picture(1), width=99).load()
    with pytest.raises(DataError, match="missing"):
        EncodedImage(tmp_path / "gone.jpg", "gone.jpg", WIDTH, HEIGHT).load()
    with pytest.raises(DataError, match="one 16-bit channel"):
        encoded(".png", picture(1), 1000.0).load()
    with pytest.raises(DataError, match="neither JPEG nor PNG"):
        EncodedImage(b"GIF89a...", "x", WIDTH, HEIGHT).load()
    with pytest.raises(DataError, match="cannot be decoded"):
        decode_gray(b"\xff\xd8 no picture \xff\xd9", "x")
