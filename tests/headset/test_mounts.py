"""Mounts that the edge is given."""

from __future__ import annotations

from pathlib import Path

import pytest

from share.errors import UsageError
from share.headset.mounts import read_mounts


def mount(x_m: float, shift_s: float) -> str:
    T = [1, 0, 0, x_m, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    rows = [T[k : k + 4] for k in range(0, 16, 4)]
    return f"T_body_viewer: {rows}\ntimeshift_device_headset: {shift_s}\n"


def test_a_mount_is_on_a_head(tmp_path: Path) -> None:
    file = tmp_path / "headset.yaml"
    file.write_text(mount(1.9, -0.9))
    assert read_mounts([f"ann={tmp_path}"])["ann"].timeshift_ms == -900
    for x_m, shift_s, said in (
        (1e4, 0.0, r"is 1e\+04 m from the eyes; at most 2 m"),
        (0.0, 1e8, "at most 1 s"),
    ):
        file.write_text(mount(x_m, shift_s))
        with pytest.raises(UsageError, match=rf"--mount: {file}: .*{said}"):
            read_mounts([f"ann={file}"])
    file.unlink()
    with pytest.raises(UsageError, match="no such file; `share calibrate headset` makes it"):
        read_mounts([f"ann={tmp_path}"])
