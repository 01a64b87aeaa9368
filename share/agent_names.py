"""What an agent may be called: it stands in lines that a person reads, so no name can look like more than a
name, or like no name at all."""

from __future__ import annotations

import re
from unicodedata import category, normalize

from share.types import MAX_NAME_LENGTH

NAME_RULE = f"1 to {MAX_NAME_LENGTH} letters, digits, '-_.+@#()' and single spaces between them"
_PUNCTUATION = "-_.+@#()"
# Signs that Unicode counts among the letters: they repeat or lengthen one, as in Japanese and Thai names.
# All others of their kind look like quotation marks, colons or accents.
_LETTER_MODIFIERS = "々〻ゝゞヽヾーｰๆໆ"
# Letters and marks that show nothing, or a quotation mark (saltillo).
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180d\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef\ua78b\ua78c]"
)


def checked_name(name: str) -> str:
    """`name` as Unicode composes it (NFC), so that names that look alike by their accents are alike.

    Raises ValueError if no agent may be called so, which does not quote it."""
    name = normalize("NFC", name)
    if not 0 < len(name) <= MAX_NAME_LENGTH:
        raise ValueError(f"name: {len(name)} characters; use {NAME_RULE}")
    previous = (
        " "  # kinds of the character before, and of the marks on it: letter, mark, digit, space or other
    )
    for character in name:
        kind = _character_class(character)
        if kind == "M" and previous in ("L", "LM"):  # two marks, as Indic and Thai names have them
            kind = previous + "M"
        if kind in (None, "M") or (kind == " " and previous == " "):
            raise ValueError(f"name: not with U+{ord(character):04X} there; use {NAME_RULE}")
        previous = kind
    if previous == " ":
        raise ValueError(f"name: ends in a space; use {NAME_RULE}")
    return name


def _character_class(character: str) -> str | None:
    """L, M, N, space or "."; None if it is in no name."""
    if character in _PUNCTUATION:
        return "."
    if character == " ":
        return " "
    if _INVISIBLE.match(character):
        return None
    kind = category(character)
    if kind in ("Lu", "Ll", "Lt", "Lo") or character in _LETTER_MODIFIERS:
        return "L"
    if kind in ("Mn", "Mc"):
        return "M"
    return "N" if kind == "Nd" else None
