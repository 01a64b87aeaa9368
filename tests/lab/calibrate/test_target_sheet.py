"""The printed sheet as a printer and a camera see it."""

import numpy as np
import pypdfium2
import pytest

from share.lab.calibrate.corners import detector
from share.lab.calibrate.target_sheet import make_sheet, sheet_pdf

INCH = 25.4


def printed(made, dpi):
    """Return the page (H, W) as gray values."""
    page = pypdfium2.PdfDocument(sheet_pdf(made))[0]
    size_mm = np.array(page.get_size()) / 72 * INCH
    assert size_mm == pytest.approx([made.width, made.height], abs=1e-3)
    return np.ascontiguousarray(page.render(scale=dpi / 72, grayscale=True).to_numpy())


@pytest.mark.parametrize(
    ("kind", "columns", "rows", "paper", "dpi"),
    [("aprilgrid", 6, 6, "A4", 60), ("aprilgrid", 4, 7, "letter", 60), ("charuco", 9, 7, "A3", 75)],
)
def test_every_corner_is_detected_at_its_place(kind, columns, rows, paper, dpi):
    made = make_sheet(kind, columns, rows, paper)
    page = printed(made, dpi)
    found = detector(made.target)(page)
    assert len(found) == len(made.target.corners)
    mm = (
        (found.px + 0.5) * (made.width, made.height) / np.array(page.shape[::-1])
    )  # whole pixels: not quite dpi
    low = made.target.extent[0]
    wanted = 1000 * (made.target.corners[found.ids, :2] - low) + (made.left, made.bottom)
    wanted[:, 1] = made.height - wanted[:, 1]
    assert np.abs(mm - wanted).max() < 0.1


def test_the_ruler_has_its_stated_length():
    dpi = 254  # ten pixels a millimetre
    made = make_sheet("aprilgrid", 6, 6, "A4")
    page = printed(made, dpi)
    y = round((made.height - 11) * dpi / INCH)  # 11 mm above the paper's edge
    dark = np.flatnonzero(page[y - 2 : y + 3].min(axis=0) < 128)
    line = np.split(dark, 1 + np.flatnonzero(np.diff(dark) > 5))[0]  # what follows is text
    assert len(line) * INCH / dpi == pytest.approx(100, abs=0.3)  # and its end marks


def test_adjacent_rectangles_show_no_seam():
    """The border of a tag is one black square."""
    made = make_sheet("aprilgrid", 6, 6, "A4")
    page = printed(made, 97)  # cells end within pixels
    tag = np.array([made.left, made.bottom]) + 1000 * made.target.gap
    x, y = (tag * 97 / INCH).astype(int)
    edge = page[-(y + 2) - 60 : -(y + 2), x + 2 : x + 8]  # within the two cells on the left
    assert edge.max() < 40


def test_the_same_board_gives_the_same_file():
    made = make_sheet("charuco", 9, 7, "A3")
    assert sheet_pdf(made) == sheet_pdf(made)
