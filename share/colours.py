"""Colours of agents and of policies: each has its own wherever it is drawn."""

from __future__ import annotations

from collections.abc import Iterable

Colour = tuple[int, int, int]  # red, green, blue, 0 to 255

# In order of appearance. The first eight are distinct also to those who see few colours, on white and on
# black (after Okabe and Ito, *Color Universal Design*, 2008); each of the others is as far as can be, in
# CIELAB, from those before it and from what is drawn of loops, corrections and trouble.
AGENT_COLOURS: tuple[Colour, ...] = (
    *((58, 151, 212), (230, 159, 0), (0, 158, 115), (199, 181, 0)),
    *((213, 94, 0), (204, 121, 167), (0, 114, 178), (153, 153, 153)),
    *((105, 0, 255), (105, 90, 45), (0, 105, 105), (240, 165, 150)),
    *((0, 90, 210), (135, 75, 0), (120, 90, 150), (210, 180, 105)),
    *((135, 75, 90), (150, 150, 105), (120, 75, 255), (120, 195, 210)),
    *((165, 30, 210), (210, 0, 150), (255, 150, 75), (150, 195, 165)),
    *((240, 120, 255), (195, 0, 255), (60, 120, 75), (105, 165, 255)),
    *((135, 120, 0), (30, 150, 180), (225, 165, 195), (90, 195, 105)),
)
POLICY_COLOURS: dict[str, Colour] = {
    "share": (0, 121, 140),
    "share-paper": (110, 190, 200),
    "covins-g": (209, 73, 91),
    "linear": (237, 174, 73),
    "equal": (102, 80, 140),
    "random": (141, 91, 76),
    "fixed": (58, 125, 68),
    "streamed": (110, 110, 110),
}
_OTHER_COLOURS = tuple(POLICY_COLOURS.values())  # of series that are neither


def agent_colour(number: int) -> Colour:
    """Return the colour of the agent that came `number`th, from 0."""
    return AGENT_COLOURS[number % len(AGENT_COLOURS)]


def hex_colour(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def agent_colours(names: Iterable[str]) -> dict[str, str]:
    """Return the colours of agents, named in order, as #rrggbb."""
    return {name: hex_colour(agent_colour(k)) for k, name in enumerate(names)}


def series_colours(names: Iterable[str]) -> dict[str, str]:
    """Return colours of series as #rrggbb: policies have their own, others follow each other."""
    distinct = list(dict.fromkeys(names))
    others = [name for name in distinct if name not in POLICY_COLOURS]
    count = len(_OTHER_COLOURS)
    return {
        name: hex_colour(POLICY_COLOURS.get(name) or _OTHER_COLOURS[others.index(name) % count])
        for name in distinct
    }
