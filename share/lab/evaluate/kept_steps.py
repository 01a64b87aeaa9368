"""Results of mapping steps that are pure functions of what they are given, kept to be used again.

In a simulation agents that replay one recording send the same keyframes, and so do people's headsets under
one policy after another. Finding features in an image and verifying two keyframes by theirs give the same
each time; what it costs in virtual time is drawn all the same.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from share.mapping.steps import DescribeStep, VerifyStep

_KEPT = {DescribeStep.kind: 4000, VerifyStep.kind: 20_000}  # some 26 kB and 1 kB each
_NOT_CONTENT = ("node_id", "candidate_id")


class KeptSteps:
    """The newest results by content. found, asked: how often there was one, of how many."""

    def __init__(self) -> None:
        self._results = {kind: OrderedDict[bytes, object]() for kind in _KEPT}
        self.found = self.asked = 0

    def run(self, step: Any) -> object:
        """Return the result of a step; it may be one of an earlier step of the same content. Raises what the
        step raises."""
        results = self._results.get(step.kind)
        if results is None:
            return step.run()
        self.asked += 1
        key = content_digest(step)
        if key in results:
            self.found += 1
            results.move_to_end(key)
            return results[key]
        results[key] = result = step.run()
        if len(results) > _KEPT[step.kind]:
            results.popitem(last=False)
        return result


def content_digest(step: object) -> bytes:
    """Return a digest of all that a step is given, but the numbers of its keyframes."""
    digest = hashlib.blake2b(digest_size=16)
    for part in _parts(step):
        digest.update(part)
    return digest.digest()


def _parts(value: object) -> Iterator[bytes]:
    """Yield the content of a value, told from that of any other."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        for one in fields(value):
            if one.name not in _NOT_CONTENT:
                yield from _parts(getattr(value, one.name))
    elif isinstance(value, tuple | list):
        yield f"{len(value)}".encode()
        for part in value:
            yield from _parts(part)
    elif value is None or isinstance(value, bool | int | float | str | bytes):
        yield repr(value).encode()
    else:
        raise TypeError(f"{type(value).__name__}: its content is not known")
