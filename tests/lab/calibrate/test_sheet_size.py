"""Size and place of a target on paper."""

import pytest

from share.lab.calibrate.target_sheet import FOOTER_MM, MARGIN_MM, make_sheet


def ends(made):
    """Left, lower, right and upper end of the black area, mm."""
    low, high = 1000 * made.target.extent
    wide, tall = high - low
    return made.left, made.bottom, made.left + wide, made.bottom + tall


@pytest.mark.parametrize("kind", ["aprilgrid", "charuco"])
@pytest.mark.parametrize("paper", ["A4", "A0", "letter", "600x300"])
def test_the_largest_target_fits_within_the_margins(kind, paper):
    made = make_sheet(kind, 6, 5, paper)
    left, low, right, high = ends(made)
    assert left == pytest.approx(made.width - right)
    assert min(left, made.height - high) >= MARGIN_MM - 1e-9
    assert low >= MARGIN_MM + FOOTER_MM - 1e-9
    edge = round(1000 * (made.target.tag_size if kind == "aprilgrid" else made.target.square))
    with pytest.raises(ValueError, match=r"at most .* mm fit"):
        make_sheet(kind, 6, 5, paper, edge + 1)


def test_a_wide_board_gets_landscape_paper():
    assert make_sheet("charuco", 9, 6, "A4").width == 297
    assert make_sheet("charuco", 6, 9, "A4").width == 210


def test_a_given_size_is_used():
    made = make_sheet("aprilgrid", 4, 5, "A3", 30.5)
    assert (made.target.cols, made.target.rows, made.target.tag_size) == (4, 5, pytest.approx(0.0305))


@pytest.mark.parametrize(
    ("columns", "paper", "edge", "message"),
    [
        (6, "A4", 30, r"6 x 6 of 30 mm do not fit on A4: at most 23.4 mm fit"),
        (6, "30x30", None, r"30x30 is too small for 6 x 6"),
        (6, "B9", None, r"'B9' is not a paper size; known: A4, A3"),
        (200, "A0", None, r"the family 36h11 has only 587"),
    ],
)
def test_an_impossible_sheet_is_refused(columns, paper, edge, message):
    with pytest.raises(ValueError, match=message):
        make_sheet("aprilgrid", columns, 6, paper, edge)


def test_many_squares_get_a_larger_dictionary():
    assert make_sheet("charuco", 9, 7, "A3").target.dictionary == "DICT_5X5_100"
    assert make_sheet("charuco", 20, 15, "A0").target.dictionary == "DICT_5X5_1000"
