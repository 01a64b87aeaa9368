"""Materials of surfaces, by name, before any picture is drawn.

A `surface` repeats: its picture covers a given number of metres. A `print` is fitted to one quad; its picture
holds cells x cells different prints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from share.types import U8


@dataclass(frozen=True)
class MaterialKind:
    """metres: extent of one picture (surfaces). cells: prints along each side of a picture (prints). gray:
    mean albedo, 0..255. gray_sigma: standard deviation of the gray over variants."""

    gray: float
    metres: float = 0.0
    cells: int = 1
    gray_sigma: float = 8.0

    @property
    def is_fitted(self) -> bool:
        return self.metres == 0


MATERIAL_KINDS: dict[str, MaterialKind] = {
    # walls and ceilings
    "plaster": MaterialKind(165, 3.0),
    "paint": MaterialKind(175, 3.0, gray_sigma=6),  # painted wall, almost without texture
    "brick": MaterialKind(115, 2.0),
    "block": MaterialKind(140, 2.4),  # concrete blocks, painted over
    "concrete": MaterialKind(130, 3.0),
    "corrugated": MaterialKind(135, 2.0),  # trapezoidal sheet metal
    "panel": MaterialKind(150, 2.4),  # cladding: broad panels with joints
    "ceiling": MaterialKind(185, 2.4),  # mineral-fibre tiles
    # floors
    "screed": MaterialKind(110, 3.0),  # worn concrete floor
    "tiles": MaterialKind(130, 2.0),
    "planks": MaterialKind(105, 2.0),
    "carpet": MaterialKind(90, 2.0),
    # objects
    "wood": MaterialKind(125, 1.0),
    "plywood": MaterialKind(145, 1.2),
    "cardboard": MaterialKind(135, 0.8, gray_sigma=14),
    "steel": MaterialKind(120, 1.2, gray_sigma=25),  # painted steel, scratched
    "lacquer": MaterialKind(130, 2.0, gray_sigma=25),  # a vehicle's body: even, faint dust
    "galvanised": MaterialKind(150, 0.8),  # spangled zinc
    "grating": MaterialKind(70, 0.6),
    "fabric": MaterialKind(90, 0.8, gray_sigma=25),
    "rubber": MaterialKind(35, 0.8, gray_sigma=5),
    "hose": MaterialKind(150, 0.5, gray_sigma=20),  # woven fire hose
    "plastic": MaterialKind(120, 0.8, gray_sigma=35),
    "glass": MaterialKind(45, 1.5),
    "stripes": MaterialKind(120, 0.5),  # hazard stripes, at 45 degrees
    "marking": MaterialKind(200, 1.0),  # worn floor paint
    "foil": MaterialKind(150, 1.0),  # stretch film around goods on a pallet
    "skin": MaterialKind(150, 0.5),
    "lamp": MaterialKind(250, 1.0, gray_sigma=0),  # emits light and casts no shadow
    # prints: fitted to the quad
    "poster": MaterialKind(150, cells=2),  # pictures and letters
    "notice": MaterialKind(195, cells=2),  # a sheet of paper with lines of text
    "sign": MaterialKind(140, cells=2),  # a few large letters or a symbol
    "label": MaterialKind(200, cells=4),  # shipping labels: bars, text
    "board": MaterialKind(150, cells=1),  # a pin board with sheets
    "goods": MaterialKind(115, cells=2),  # small objects on a shelf, from the front
    "books": MaterialKind(110, cells=2),  # spines of files and books
    "tools": MaterialKind(140, cells=1),  # a tool wall
    "gauge": MaterialKind(110, cells=2),  # an instrument or fuse panel
    "door": MaterialKind(140, cells=1),
    "locker": MaterialKind(130, cells=1),
    "shutter": MaterialKind(150, cells=1),  # a roller door
    "window": MaterialKind(190, cells=1),
    "screen": MaterialKind(60, cells=2),
}


@dataclass(frozen=True)
class Material:
    """One picture, different for every variant and every seed of the room.

    kind: a key of `MATERIAL_KINDS`. gray: mean albedo 0..255 instead of the kind's. contrast: multiplies the
    deviation from the mean. metres: extent of one picture instead of the kind's (surfaces only). Raises
    ValueError for an unknown kind.
    """

    kind: str
    variant: int = 0
    gray: float | None = None
    contrast: float = 1.0
    metres: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in MATERIAL_KINDS:
            raise ValueError(f"material '{self.kind}' is not known; known: {', '.join(MATERIAL_KINDS)}")

    @property
    def is_fitted(self) -> bool:
        """Return whether it is a print."""
        return MATERIAL_KINDS[self.kind].is_fitted

    @property
    def cells(self) -> int:
        """Return the prints along each side of its picture; 1 for a surface."""
        return MATERIAL_KINDS[self.kind].cells

    @property
    def extent(self) -> float:
        """Return the metres that one picture covers; 0 for a print."""
        return self.metres or MATERIAL_KINDS[self.kind].metres

    @property
    def is_glowing(self) -> bool:
        """Return whether it emits light: it casts no shadow and is not lit."""
        return self.kind == "lamp"


@dataclass(frozen=True, eq=False)
class GivenMaterial:
    """A given picture: pixels (P, P) uint8. One extent of it is 1 in uv."""

    pixels: U8
    is_fitted: ClassVar[bool] = False
    cells: ClassVar[int] = 1
    extent: ClassVar[float] = 1.0
    is_glowing: ClassVar[bool] = False
