"""Replaces, in the frozen program, modules that our libraries import and SHARE never calls.

SciPy's linear programming (HiGHS): every import of scipy.optimize loads its 7 MB and makes tables of its
names. filterpy.stats: every import of filterpy.kalman would bring scipy.stats, 4 MB and half a second.
"""

from __future__ import annotations

from typing import NoReturn


class _Name:
    """Any attribute: it has further attributes, and cannot be called."""

    def __getattr__(self, name: str) -> _Name:
        return _named(name)

    def __call__(self, *_: object) -> NoReturn:
        raise NotImplementedError("this frozen program leaves out what it never calls: see tools/left_out.py")


def _named(name: str) -> _Name:
    if name.startswith("__"):
        raise AttributeError(name)  # Python's own look-ups
    return _Name()


__getattr__ = _named
