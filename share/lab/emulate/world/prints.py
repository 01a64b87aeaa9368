"""Prints, each fitted to one quad: posters, labels, fronts of shelves. Gray levels (n, n) uint8."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from share.lab.emulate.world.noise import cloud
from share.types import U8

Rng = np.random.Generator
Print = Callable[[Rng, int], U8]

_LETTERS = list("ABCDEFGHKLMNPRSTUVXYZ2345789")
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX)


def _background(rng: Rng, n: int, gray: float, soft: float = 8, fine: float = 2) -> U8:
    """A plain ground with soft variation."""
    noise = soft * cloud(rng, 1.5, high=n / 8, size=n) + fine * cloud(rng, 0.4, low=n / 10, size=n)
    return (gray + noise).clip(4, 250).astype(np.uint8)


def _random_text(rng: Rng, count: int) -> str:
    return "".join(rng.choice(_LETTERS, count))


def _write_text(rng: Rng, sheet: U8, text: str, box: tuple[int, int, int, int], gray: float) -> None:
    """Write `text` into the box (x, y, width, height) in texels, as large as it fits."""
    x, y, w, h = box
    font = int(_FONTS[int(rng.integers(len(_FONTS)))])
    (tw, th), _ = cv2.getTextSize(text, font, 1.0, 1)
    scale = 0.92 * min(w / tw, h / th)
    thick = max(1, round(0.09 * th * scale))
    at = (x + round((w - tw * scale) / 2), y + round((h + th * scale) / 2))
    cv2.putText(sheet, text, at, font, scale, gray, thick, cv2.LINE_AA)


def _text_lines(rng: Rng, sheet: U8, box: tuple[int, int, int, int], pitch: int, gray: float) -> None:
    """Draw lines of print too small to read: words as dashes."""
    x, y, w, h = box
    for top in range(y, y + h - pitch // 2, pitch):
        left, end = x, x + int(w * rng.uniform(0.6, 1))
        while left < end:
            right = min(left + int(rng.uniform(1.0, 5.0) * pitch), end)
            cv2.rectangle(sheet, (left, top), (right, top + max(pitch // 2 - 1, 0)), gray, -1)
            left = right + max(pitch // 2, 2)


def poster(rng: Rng, n: int) -> U8:
    """Shapes, a picture and a title in a frame."""
    sheet = _background(rng, n, rng.uniform(60, 215), 16, 4)
    for _ in range(int(rng.integers(4, 9))):
        x, y = rng.integers(0, n, 2).tolist()
        d = int(rng.uniform(0.05, 0.3) * n)
        gray, line = float(rng.uniform(25, 235)), int(rng.choice([-1, -1, 2, 4]))
        shape = rng.integers(3)
        if shape == 0:
            cv2.rectangle(sheet, (x, y), (x + d, y + int(d * rng.uniform(0.3, 1.5))), gray, line)
        elif shape == 1:
            axes = (d, int(d * rng.uniform(0.3, 1)))
            cv2.ellipse(sheet, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, gray, line, cv2.LINE_AA)
        else:
            corners = (np.array([x, y]) + rng.integers(-d, d + 1, (3, 2))).astype(np.int32)
            cv2.fillConvexPoly(sheet, corners, gray, cv2.LINE_AA)
    ink = float(rng.choice([20, 235]))
    _write_text(
        rng,
        sheet,
        _random_text(rng, int(rng.integers(4, 9))),
        (n // 10, n // 14, 4 * n // 5, n // 6),
        ink,
    )
    _text_lines(rng, sheet, (n // 8, 3 * n // 4, n // 2, n // 6), max(n // 40, 4), ink)
    cv2.rectangle(sheet, (0, 0), (n - 1, n - 1), float(rng.uniform(10, 240)), max(n // 60, 2))
    return sheet


def notice(rng: Rng, n: int) -> U8:
    """A sheet of paper: a heading, lines of text, perhaps a table."""
    sheet = _background(rng, n, rng.uniform(185, 225), 5, 1.5)
    ink = float(rng.uniform(25, 70))
    _write_text(rng, sheet, _random_text(rng, 7), (n // 8, n // 12, 3 * n // 4, n // 8), ink)
    _text_lines(rng, sheet, (n // 8, n // 4, 3 * n // 4, n // 4), max(n // 36, 4), ink + 30)
    if rng.random() < 0.5:
        for t in np.linspace(0.58, 0.9, 5):
            cv2.line(sheet, (n // 8, int(t * n)), (7 * n // 8, int(t * n)), ink, 1)
        for s in np.linspace(0.125, 0.875, int(rng.integers(3, 6))):
            cv2.line(sheet, (int(s * n), int(0.58 * n)), (int(s * n), int(0.9 * n)), ink, 1)
    else:
        _text_lines(rng, sheet, (n // 8, 4 * n // 7, 3 * n // 4, n // 3), max(n // 36, 4), ink + 30)
    return sheet


def sign(rng: Rng, n: int) -> U8:
    """A few large letters over a band, or an arrow."""
    dark = rng.random() < 0.5
    ground, ink = (rng.uniform(35, 90), 225.0) if dark else (rng.uniform(170, 220), 30.0)
    sheet = _background(rng, n, ground, 4, 1)
    words = _random_text(rng, int(rng.integers(1, 4)))
    if rng.random() < 0.4:
        tip = (n // 6, n // 3) if rng.random() < 0.5 else (5 * n // 6, n // 3)
        cv2.arrowedLine(sheet, (n - tip[0], tip[1]), tip, ink, n // 12, cv2.LINE_AA, 0, 0.35)
        _write_text(rng, sheet, words, (n // 8, n // 2, 3 * n // 4, 3 * n // 8), ink)
    else:
        _write_text(rng, sheet, words, (n // 10, n // 8, 4 * n // 5, 5 * n // 8), ink)
        cv2.rectangle(sheet, (0, 5 * n // 6), (n, n), float(rng.uniform(40, 200)), -1)
    cv2.rectangle(sheet, (0, 0), (n - 1, n - 1), ink, max(n // 40, 2))
    return sheet


def label(rng: Rng, n: int) -> U8:
    """A shipping label: bars, a number, lines."""
    sheet = _background(rng, n, rng.uniform(190, 230), 3, 1)
    x = n // 10
    while x < 9 * n // 10:
        wide = int(rng.integers(1, max(n // 24, 3)))
        cv2.rectangle(sheet, (x, n // 2), (x + wide - 1, 4 * n // 5), 35.0, -1)
        x += wide + int(rng.integers(2, max(n // 20, 4)))
    _write_text(rng, sheet, _random_text(rng, 6), (n // 10, n // 12, 4 * n // 5, n // 5), 30.0)
    _text_lines(rng, sheet, (n // 10, n // 3, 3 * n // 5, n // 8), max(n // 20, 4), 60.0)
    return sheet


def board(rng: Rng, n: int) -> U8:
    """A pin board with sheets that overlap."""
    sheet = _background(rng, n, rng.uniform(95, 135), 6, 8)
    for _ in range(int(rng.integers(9, 17))):
        size = int(rng.uniform(0.12, 0.3) * n)
        paper = (poster if rng.random() < 0.4 else notice)(rng, size)[:, : int(size * rng.uniform(0.65, 1))]
        y, x = int(rng.integers(0, n - size)), int(rng.integers(0, n - size))
        sheet[y : y + size, x : x + paper.shape[1]] = paper
    cv2.rectangle(sheet, (0, 0), (n - 1, n - 1), 60.0, n // 50)
    return sheet


def _shelf_rows(
    rng: Rng, n: int, rows: int, tallest: float, widths: tuple[float, float], filled: float
) -> U8:
    """Upright objects side by side on boards, of all heights, some missing."""
    sheet = _background(rng, n, 42, 6, 2)
    pitch = n // rows
    for foot in range(pitch - 1, n, pitch):
        x = 1
        while x < n - 3:
            wide = max(3, int(rng.uniform(*widths) * n))
            if rng.random() < filled:
                tall = int(pitch * rng.uniform(0.55, tallest))
                gray = float(rng.uniform(55, 205))
                right = min(x + wide - 2, n - 2)
                cv2.rectangle(sheet, (x, foot - tall), (right, foot), gray, -1)
                band = foot - int(tall * rng.uniform(0.3, 0.8))
                tone = float(np.clip(gray + rng.choice([-60, 60, 90]), 20, 240))
                cv2.rectangle(sheet, (x + 1, band), (right - 1, band + tall // 5), tone, -1)
                cv2.line(sheet, (right, foot - tall), (right, foot), gray * 0.6, 1)
            x += wide
        cv2.rectangle(sheet, (0, foot - max(n // 90, 2)), (n, foot), float(rng.uniform(110, 160)), -1)
    return _soften(sheet)


def goods(rng: Rng, n: int) -> U8:
    """Small objects on a shelf, from the front."""
    return _shelf_rows(rng, n, int(rng.integers(2, 4)), 0.85, (0.08, 0.25), 0.85)


def books(rng: Rng, n: int) -> U8:
    """Spines of files and books."""
    return _shelf_rows(rng, n, 2, 0.9, (0.03, 0.09), 0.93)


def tools(rng: Rng, n: int) -> U8:
    """A wall of hanging tools."""
    sheet = _background(rng, n, rng.uniform(130, 170), 4, 2)
    for x in range(n // 10, n, n // 7):
        for y in range(n // 12, n - n // 5, n // 4):
            if rng.random() < 0.2:
                continue
            gray, long = float(rng.choice([35, 60, 90, 215])), int(rng.uniform(0.08, 0.2) * n)
            cv2.line(
                sheet, (x, y), (x + int(rng.integers(-4, 5)), y + long), gray, max(2, n // 60), cv2.LINE_AA
            )
            head = (int(rng.uniform(0.01, 0.045) * n), int(rng.uniform(0.01, 0.03) * n))
            cv2.ellipse(sheet, (x, y), head, float(rng.uniform(0, 90)), 0, 360, gray, -1, cv2.LINE_AA)
    return _soften(sheet)


def gauge(rng: Rng, n: int) -> U8:
    """Dials, switches and lamps on a panel."""
    sheet = _background(rng, n, rng.uniform(80, 150), 4, 1)
    step = n // 4
    for y in range(step // 2, n, step):
        for x in range(step // 2, n, step):
            r, what = int(step * rng.uniform(0.22, 0.4)), rng.integers(4)
            if what == 0:
                cv2.circle(sheet, (x, y), r, 215.0, -1, cv2.LINE_AA)
                turn = rng.uniform(0, 2 * np.pi)
                end = (int(x + r * np.cos(turn)), int(y + r * np.sin(turn)))
                cv2.line(sheet, (x, y), end, 30.0, max(2, r // 8), cv2.LINE_AA)
                cv2.circle(sheet, (x, y), r, 35.0, 2, cv2.LINE_AA)
            elif what == 1:
                cv2.rectangle(
                    sheet, (x - r // 2, y - r), (x + r // 2, y + r), float(rng.choice([40, 200])), -1
                )
            elif what == 2:
                _text_lines(rng, sheet, (x - r, y - r, 2 * r, 2 * r), max(r // 3, 4), 30.0)
            else:
                cv2.circle(sheet, (x, y), r // 2, float(rng.choice([30, 235])), -1, cv2.LINE_AA)
    cv2.rectangle(sheet, (0, 0), (n - 1, n - 1), 40.0, max(n // 60, 2))
    return sheet


def door(rng: Rng, n: int) -> U8:
    """A door leaf in its frame: handle, a plate, perhaps a pane."""
    gray = rng.uniform(90, 180)
    sheet = _background(rng, n, gray, 4, 1)
    cv2.rectangle(sheet, (0, 0), (n - 1, n - 1), gray * 0.6, n // 16)
    cv2.rectangle(sheet, (n // 16, n // 24), (n - n // 16, n), gray * 0.45, 2)
    if rng.random() < 0.6:
        cv2.rectangle(sheet, (n // 3, n // 7), (2 * n // 3, 3 * n // 7), float(rng.choice([40, 210])), -1)
        cv2.rectangle(sheet, (n // 3, n // 7), (2 * n // 3, 3 * n // 7), gray * 0.5, 4)
    cv2.rectangle(sheet, (5 * n // 6, n // 2), (5 * n // 6 + n // 30, n // 2 + n // 12), 45.0, -1)
    cv2.line(sheet, (5 * n // 6, n // 2 + n // 40), (5 * n // 6 - n // 9, n // 2 + n // 40), 60.0, n // 70)
    cv2.rectangle(sheet, (n // 12, 9 * n // 10), (n - n // 12, n), gray * 0.8, -1)
    return sheet


def locker(rng: Rng, n: int) -> U8:
    """Narrow doors with slots, a lock and a number."""
    gray = rng.uniform(90, 170)
    sheet = _background(rng, n, gray, 4, 1)
    wide = n // 3
    for k in range(3):
        x = k * wide
        cv2.rectangle(sheet, (x + 2, 3), (x + wide - 2, n - 4), gray * 0.5, 2)
        for y in range(n // 14, n // 14 + 5 * (n // 50), n // 50):
            cv2.line(sheet, (x + wide // 4, y), (x + 3 * wide // 4, y), gray * 0.55, 2)
        cv2.circle(sheet, (x + 5 * wide // 6, n // 2), n // 64, 40.0, -1, cv2.LINE_AA)
        plate = (x + wide // 3, n // 4, wide // 3, n // 16)
        cv2.rectangle(sheet, plate[:2], (plate[0] + plate[2], plate[1] + plate[3]), 215.0, -1)
        _write_text(rng, sheet, str(rng.integers(10, 99)), plate, 30.0)
    return sheet


def shutter(rng: Rng, n: int) -> U8:
    """A roller door: slats, some dented, a bar at the bottom."""
    gray = rng.uniform(120, 175)
    sheet = _background(rng, n, gray, 5, 1)
    for y in range(0, n, n // 32):
        cv2.line(sheet, (0, y), (n, y), gray - rng.uniform(8, 22), 2)
    cv2.rectangle(sheet, (0, 15 * n // 16), (n, n), gray * 0.5, -1)
    return sheet


def window(rng: Rng, n: int) -> U8:
    """Bright panes between dark bars, something vague behind."""
    sheet = _background(rng, n, rng.uniform(195, 215), 18, 1)
    for k in range(int(rng.integers(2, 4)) + 1):
        at = round(k * n / 3)
        cv2.line(sheet, (at, 0), (at, n), 70.0, n // 40)
        cv2.line(sheet, (0, at), (n, at), 70.0, n // 40)
    cv2.rectangle(sheet, (0, 0), (n - 1, n - 1), 80.0, n // 20)
    return sheet


def screen(rng: Rng, n: int) -> U8:
    """A monitor: windows, lines, a curve."""
    sheet = _background(rng, n, rng.uniform(25, 60), 2, 0.5)
    x, y = rng.integers(n // 12, n // 3, 2).tolist()
    cv2.rectangle(sheet, (x, y), (x + n // 2, y + n // 2), 170.0, -1)
    _text_lines(rng, sheet, (x + n // 20, y + n // 12, n // 3, n // 3), max(n // 36, 4), 50.0)
    curve = np.stack([np.linspace(0, n - 1, 40), n * (0.85 + 0.04 * np.cumsum(rng.normal(0, 0.5, 40)))], 1)
    cv2.polylines(sheet, [curve.round().astype(np.int32)], False, 200.0, 2, cv2.LINE_AA)
    cv2.rectangle(sheet, (0, 0), (n - 1, n - 1), 15.0, n // 24)
    return sheet


def _soften(sheet: U8) -> U8:
    return np.asarray(cv2.GaussianBlur(sheet, (0, 0), 0.6), np.uint8)


PRINTS: dict[str, Print] = {
    f.__name__: f
    for f in (
        poster, notice, sign, label, board, goods, books, tools, gauge, door, locker, shutter, window, screen,
    )
}  # fmt: skip
