"""A head put onto the backbone that it was taught for, with the labels that it was taught on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.errors import UsageError
from share.files.json_file import as_we_write_it
from share.lab.train.fitted import Fitted, read_fitted
from share.lab.train.graph import backbone_id, with_heads
from share.lab.train.rivals import Rows
from share.lab.train.table import Collection, collect
from share.odometry.error_model.model import Network
from share.odometry.error_model.network import deep_of, open_network, read_model
from share.types import F32


@dataclass(frozen=True, eq=False)
class Assembly:
    """model: the file; deep (N, 1280): of the collection's table."""

    fitted: Fitted
    collection: Collection
    model: bytes
    network: Network
    deep: F32

    @property
    def test(self) -> Rows:
        """Keyframes that nothing was learnt from."""
        return Rows(self.collection.table, self.deep).take(self.collection.of("test"))


def assemble(fit: Path, labels: Path, base: Path) -> Assembly:
    """fit: a folder by `share train fit`. Raises UsageError where labels or base are not what it was taught
    on, DataError."""
    fitted = read_fitted(file := fit / "fit.npz")
    with as_we_write_it(file):
        seed, backbone = int(fitted.about["options"]["seed"]), fitted.about["backbone"]
    collection = collect(labels, seed)
    with as_we_write_it(file):
        _check_rooms(collection, fitted.about, labels)
    given = read_model(base)
    if backbone_id(given) != backbone:
        raise UsageError(f"{base}: has another backbone than the one that {fit} was taught for")
    with as_we_write_it(file):
        model = with_heads(given, fitted)
    network = open_network(model)
    return Assembly(fitted, collection, model, network, deep_of(network, collection.table.picture))


def _check_rooms(collection: Collection, about: Mapping[str, Any], labels: Path) -> None:
    """Else a test would be on what was learnt."""
    for part, runs in collection.parts.items():
        here = {str(collection.abouts[run]["session"]) for run in runs.tolist()}
        if here != set(about["rooms"][part]):
            raise UsageError(f"{labels}: is not what it was taught on; sessions of '{part}' differ")
