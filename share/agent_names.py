"""Rules for agent names. Names appear in lines that people read, so none may be invisible or look like other
text."""

from __future__ import annotations

import re
from unicodedata import category, normalize

from share.types import MAX_NAME_LENGTH, MAX_RUN_KEY_LENGTH

NAME_RULE = f"1 to {MAX_NAME_LENGTH} letters, digits, '-_.+@#()' and single spaces between them"
_PUNCTUATION = "-_.+@#()"
# Unicode modifier letters that repeat or lengthen a letter, as in Japanese and Thai names. All others look
# like quotation marks, colons or accents.
_LETTER_MODIFIERS = "々〻ゝゞヽヾーｰๆໆ"
# Letters and marks that are invisible, or look like a quotation mark (saltillo).
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180d\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef\ua78b\ua78c]"
)


def checked_name(name: str) -> str:
    """Return `name` composed (NFC), so that names with the same accents are equal.

    Raises ValueError, whose text does not quote it, if the name is not allowed."""
    return _checked(normalize("NFC", name), MAX_NAME_LENGTH)


def checked_run_key(key: str) -> str:
    """Return a run's key: an agent's name with some digits. Raises ValueError if it is none."""
    if normalize("NFC", key) != key:
        raise ValueError("key of a run: is not composed")
    return _checked(key, MAX_RUN_KEY_LENGTH)


def _checked(name: str, max_length: int) -> str:
    if not 0 < len(name) <= max_length:
        raise ValueError(f"name: {len(name)} characters; use {NAME_RULE}")
    previous = " "  # class of the previous character, with its marks
    for character in name:
        kind = _character_class(character)
        if kind == "M" and previous in ("L", "LM"):  # up to two marks, as in Indic and Thai names
            kind = previous + "M"
        if kind in (None, "M") or (kind == " " and previous == " "):
            raise ValueError(f"name: U+{ord(character):04X} is not allowed there; use {NAME_RULE}")
        previous = kind
    if previous == " ":
        raise ValueError(f"name: ends in a space; use {NAME_RULE}")
    return name


def _character_class(character: str) -> str | None:
    """Return L (letter), M (mark), N (digit), space or "." (punctuation); None if not allowed."""
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


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names as people do: agent2 before agent10."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if part.isdigit() else (0, part) for part in parts]
