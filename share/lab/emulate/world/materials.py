"""What surfaces are made of, by name, before any picture is drawn.

A `surface` repeats: its picture covers a stated number of metres. A `print` is fitted to the quad it is
put on; its picture holds cells x cells different ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from share.types import U8


@dataclass(frozen=True)
class Kind:
    """metres: extent of one picture (surfaces). cells: prints along each side of a picture (prints).
    gray: mean albedo, 0..255. spread: how far the gray of one variant strays from it (sigma)."""

    gray: float
    metres: float = 0.0
    cells: int = 1
    spread: float = 8.0

    @property
    def fitted(self) -> bool:
        return self.metres == 0


KINDS: dict[str, Kind] = {
    # walls and ceilings
    "plaster": Kind(165, 3.0),
    "paint": Kind(175, 3.0, spread=6),  # a painted wall: almost nothing to see
    "brick": Kind(115, 2.0),
    "block": Kind(140, 2.4),  # concrete blocks, painted over
    "concrete": Kind(130, 3.0),
    "corrugated": Kind(135, 2.0),  # trapezoidal sheet metal
    "panel": Kind(150, 2.4),  # cladding: broad panels with joints
    "ceiling": Kind(185, 2.4),  # mineral-fibre tiles
    # floors
    "screed": Kind(110, 3.0),  # worn concrete floor
    "tiles": Kind(130, 2.0),
    "planks": Kind(105, 2.0),
    "asphalt": Kind(80, 2.0),
    "carpet": Kind(90, 2.0),
    # things
    "wood": Kind(125, 1.0),
    "plywood": Kind(145, 1.2),
    "cardboard": Kind(135, 0.8, spread=14),
    "steel": Kind(120, 1.2, spread=25),  # painted steel, scratched
    "lacquer": Kind(130, 2.0, spread=25),  # a vehicle's body: even, faint dust
    "galvanised": Kind(150, 0.8),  # spangled zinc
    "perforated": Kind(125, 0.6),  # board with rows of holes
    "grating": Kind(70, 0.6),
    "tarpaulin": Kind(110, 1.6, spread=25),
    "fabric": Kind(90, 0.8, spread=25),
    "rubber": Kind(35, 0.8, spread=5),
    "hose": Kind(150, 0.5, spread=20),  # woven fire hose
    "plastic": Kind(120, 0.8, spread=35),
    "glass": Kind(45, 1.5),
    "stripes": Kind(120, 0.5),  # hazard stripes, at 45 degrees
    "marking": Kind(200, 1.0),  # worn floor paint
    "foil": Kind(150, 1.0),  # stretch film around goods on a pallet
    "skin": Kind(150, 0.5),
    "lamp": Kind(250, 1.0, spread=0),  # shines by itself and casts no shadow
    # prints: fitted to the quad
    "poster": Kind(150, cells=2),  # pictures and letters
    "notice": Kind(195, cells=2),  # a sheet of paper with lines of text
    "sign": Kind(140, cells=2),  # a few large letters or a symbol
    "label": Kind(200, cells=4),  # shipping labels: bars, text
    "board": Kind(150, cells=1),  # a pin board with sheets
    "goods": Kind(115, cells=2),  # small things on a shelf, seen from the front
    "books": Kind(110, cells=2),  # spines of files and books
    "tools": Kind(140, cells=1),  # a tool wall
    "gauge": Kind(110, cells=2),  # an instrument or fuse panel
    "door": Kind(140, cells=1),
    "locker": Kind(130, cells=1),
    "shutter": Kind(150, cells=1),  # a roller door
    "window": Kind(190, cells=1),
    "screen": Kind(60, cells=2),
}


@dataclass(frozen=True)
class Material:
    """One picture: another one for every variant and every seed of the room.

    kind: a key of `KINDS`. gray: mean albedo 0..255 instead of the kind's own. contrast: multiplies the
    deviation from the mean. metres: extent of one picture instead of the kind's own (surfaces only).
    text: what is written on a `sign`; random letters if empty. Raises ValueError for an unknown kind.
    """

    kind: str
    variant: int = 0
    gray: float | None = None
    contrast: float = 1.0
    metres: float | None = None
    text: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"material '{self.kind}' is not known; known: {', '.join(KINDS)}")

    @property
    def fitted(self) -> bool:
        """Whether it is a print."""
        return KINDS[self.kind].fitted

    @property
    def cells(self) -> int:
        """Prints along each side of its picture; 1 for a surface."""
        return KINDS[self.kind].cells

    @property
    def extent(self) -> float:
        """Metres that one picture covers; 0 for a print."""
        return self.metres or KINDS[self.kind].metres

    @property
    def glows(self) -> bool:
        """Whether it shines by itself: it casts no shadow and is not lit."""
        return self.kind == "lamp"


@dataclass(frozen=True, eq=False)
class Given:
    """A picture that somebody else has drawn: pixels (P, P) uint8. One extent of it is 1 in uv."""

    pixels: U8
    fitted: ClassVar[bool] = False
    cells: ClassVar[int] = 1
    extent: ClassVar[float] = 1.0
    glows: ClassVar[bool] = False
