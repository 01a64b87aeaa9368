"""What SHARE itself writes and reads again, as somebody else may have made it: reports, arrays, keys,
settings; and what lies in the folder that is written to."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.special_files import KINDS, special
from matplotlib import pyplot

from share.errors import ConfigError, DataError, ShareError, UsageError
from share.files.arrays import read_array, read_arrays
from share.files.json_file import parse_json, read_json, read_json_lines
from share.files.line_file import GrowingFile
from share.files.yaml_file import read_settings, read_yaml
from share.lab.emulate.recordings import read_chunk
from share.lab.emulate.world.room_files import load_room, open_renderer
from share.lab.evaluate import charts
from share.lab.evaluate.charts import draw_bars
from share.lab.evaluate.report import html_page, read_section
from share.lab.evaluate.trial import read_trial
from share.lab.evaluate.virtual_time import read_delays
from share.lab.train.labels import Labels, read_labels, write_labels
from share.lab.train.score import read_scores
from share.lab.train.trained_heads import TrainedHeads, read_trained, write_trained
from share.net.keys import AllowList
from share.odometry.error_model.inputs import INPUT_SHAPES, input_dtype
from share.recordings.tables import read_table

pytestmark = pytest.mark.usefixtures("soon")


# ------------------------------------------------------------------ arrays


def npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    text = header.encode() + b"\n"
    return (
        b"\x93NUMPY"
        + bytes([version, 0])
        + len(text).to_bytes(2 if version == 1 else 4, "little")
        + text
        + data
    )


def archive(path: Path, **files: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
        for name, data in files.items():
            out.writestr(f"{name}.npy", data)
    return path


HEADER = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3)}"
BAD = {
    "more than there is": npy(HEADER.replace("(2, 3)", "(1000000000000, 1000000)"), bytes(24)),
    "less than there is": npy(HEADER, bytes(28)),
    "negative": npy(HEADER.replace("(2, 3)", "(-2, -3)"), bytes(24)),
    "no numbers": npy(HEADER.replace("(2, 3)", "('a',)"), bytes(24)),
    "objects": npy(HEADER.replace("<f4", "|O"), b"cos\nsystem\n(S'id'\ntR."),
    "objects in a record": npy(HEADER.replace("'<f4'", "[('a', '|O')]"), bytes(48)),
    "nothing wide": npy(HEADER.replace("<f4", "|V0"), b""),
    "nested": npy("(" * 5000, b""),
    "long": npy(" " * 60_000 + HEADER, bytes(24)),
    "other version": npy(HEADER, bytes(24), 3),
    "cut": npy(HEADER, bytes(24))[:20],
    "none": b"no array",
}


@pytest.mark.parametrize("name", BAD)
def test_arrays_that_contradict_their_header_are_refused(tmp_path, name):
    (tmp_path / "a.npy").write_bytes(BAD[name])
    with pytest.raises(DataError, match=r"a\.npy: is not an array file, or damaged"):
        read_array(tmp_path / "a.npy")
    with pytest.raises(DataError, match=r"a\.npz: is none, or damaged"):
        read_arrays(archive(tmp_path / "a.npz", x=BAD[name]), "is none")


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_are_read_as_by_numpy(tmp_path, order, rng):
    arrays = {
        "a": np.asarray(rng.standard_normal((3, 4, 5)), order=order),
        "b": np.array("text: ö"),
        "c": np.arange(5, dtype=">i2"),
        "d": np.zeros((0, 7), np.uint8),
        "e": np.array(2.5),
    }
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = read_arrays(tmp_path / "a.npz", "")
    assert found.keys() == arrays.keys()
    for name, value in arrays.items():
        np.testing.assert_array_equal(found[name], value)
        assert found[name].dtype == value.dtype
        np.save(tmp_path / "a.npy", value)
        np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), value)


def test_an_archive_bomb_is_not_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out, out.open("x.npy", "w") as file:
        for _ in range(30):
            file.write(bytes(10**6))
    monkeypatch.setattr(zipfile.ZipFile, "open", None)  # would be a TypeError
    with pytest.raises(DataError, match=r"too large: 1 arrays that unpack to 30\.0 MB"):
        read_arrays(path, "is none", 20 * 10**6)


def labels(count: int = 3) -> Labels:
    columns = (np.zeros((count, *shape), input_dtype(name)) for name, shape in INPUT_SHAPES.items())
    return Labels({"session": "s"}, np.arange(count), np.zeros(count, np.float32), *columns)


def test_labels_of_other_shapes_and_types_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    write_labels(path, labels())
    assert len(read_labels(path)) == 3
    with np.load(path) as found:
        whole = dict(found)
    for name, bad in (
        ("psd", np.zeros((3, 2, 12, 16), np.float32)),
        ("picture", np.zeros((3, 128, 128), np.float64)),
        ("error_cm", np.zeros(2, np.float32)),
        ("about", np.array("[1]")),
        ("about", np.array('{"schema": 4e999}')),
        ("about", np.array("[" * 100_000)),
        ("about", np.array(5)),
    ):
        np.savez(path, **{**whole, name: bad})
        with pytest.raises(DataError, match=r"a\.npz: "):
            read_labels(path)


def test_non_finite_weights_are_refused(tmp_path):
    head = {"a.weight": np.full(3, np.nan, np.float32)}
    write_trained(tmp_path / "fit.npz", TrainedHeads([head], 0.1, np.zeros(96), np.eye(96), {}))
    with pytest.raises(DataError, match=r"0/a\.weight is not finite"):
        read_trained(tmp_path / "fit.npz")


# ------------------------------------------------------------------ JSON


@pytest.mark.parametrize(
    "text", ["NaN", "[Infinity]", '{"a": -Infinity}', "1e999", "1" + "0" * 400, "-" + "9" * 5000, "[" * 10**5]
)
def test_json_with_non_finite_or_huge_numbers_is_refused(tmp_path, text):
    with pytest.raises(ValueError, match=r"is not a valid number|nested too deeply"):
        parse_json(text)
    (tmp_path / "a.json").write_text(f'{{"x": {text}}}\n')
    for read in (read_json, read_json_lines):
        with pytest.raises(DataError, match=r"a\.json.*: is damaged"):
            read(tmp_path / "a.json")


def run(folder: Path, **changes: object) -> Path:
    folder.mkdir(exist_ok=True)
    record = {"policy": "share", "session": str(folder), **changes}
    (folder / "run.json").write_text(json.dumps(record))
    return folder


@pytest.mark.parametrize(
    "change",
    [{"policy": 5}, {"seed": []}, {"virtual": "yes"}, {"session": 5}, {"code": {}}, {"error_model": 1}],
)
def test_run_records_of_other_types_are_refused(tmp_path, change):
    with pytest.raises(DataError, match=r"run\.json: is damaged"):
        read_trial(run(tmp_path / "a", **change))


@pytest.mark.parametrize(
    "report", [{}, {"track_ms": 5}, {"track_ms": {"p50": "x"}}, {"track_ms": {"p50": None}}]
)
def test_delays_from_invalid_reports_are_refused(tmp_path, report):
    for name in ("edge", "ann"):
        (tmp_path / name).mkdir()
    (tmp_path / "edge/edge.json").write_text("{}")
    (tmp_path / "ann/report.json").write_text(json.dumps(report))
    with pytest.raises(ShareError) as error:
        read_delays(tmp_path)
    assert str(tmp_path) in str(error.value)


@pytest.mark.parametrize(
    "row",
    [
        "5",
        "{}",
        '{"name": 5, "rmse_cm": 1}',
        '{"name": "a", "rmse_cm": "x", "mae_cm": 1, "rank": 1, "qoe_error": 1}',
    ],
)
def test_scores_of_other_types_are_refused(tmp_path, row):
    (tmp_path / "a.json").write_text(f"[{row}]")
    with pytest.raises(DataError, match="not a file of `share train compare --json`, or damaged"):
        read_scores(tmp_path / "a.json")


# ------------------------------------------------------------------ settings


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("trackr: {}", r"unknown key 'trackr'; did you mean 'tracker'\?"),
        ("edge: {max_agent: 3}", r"edge: unknown key 'max_agent'; did you mean 'max_agents'\?"),
        ("5: 1", "unknown key '5'"),
        ("\0: 1", "not valid YAML"),
        ("edge: {max_agents: .inf}", "max_agents: expected"),
        ("edge: {max_agents: 1" + "0" * 50 + "}", "max_agents: expected a number from 0 to 1e"),
        ("edge: {max_agents: 1e400}", "max_agents: expected"),
        ("edge: [1]", "edge: expected keys and values"),
        ("5", "expected keys and values"),
    ],
)
def test_invalid_settings_are_refused(tmp_path, text, says):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=says) as error:
        read_settings(tmp_path / "c.yaml")
    assert "\n" not in str(error.value) and "c.yaml" in str(error.value)


def test_an_unknown_key_gives_one_line(tmp_path, share):
    (tmp_path / "c.yaml").write_text("edge:\n  max_agent: 3\n")
    done = share("track", tmp_path, "--config", tmp_path / "c.yaml")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "edge: unknown key 'max_agent'; did you mean 'max_agents'?" in done.err


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-32"])
def test_byte_order_marks_are_accepted_or_refused(tmp_path, encoding):
    (tmp_path / "a.yaml").write_bytes("a: 1\n".encode(encoding))
    (tmp_path / "a.csv").write_bytes("1,2.5\n2,3.5\n".encode(encoding))
    if encoding == "utf-8-sig":
        assert read_yaml(tmp_path / "a.yaml").data == {"a": 1}
        assert read_table(tmp_path / "a.csv", 2)[0].tolist() == [1, 2]
        return
    with pytest.raises(ConfigError):
        read_yaml(tmp_path / "a.yaml")
    with pytest.raises(DataError, match="is not a text file"):
        read_table(tmp_path / "a.csv", 2)


# ------------------------------------------------------------------ what is no file, whoever reads it

READERS = {
    "a.npz": read_labels,
    "fit.npz": read_trained,
    "a.npy": read_array,
    "a.json": read_scores,
    "b.json": read_json,
    "events.jsonl": read_json_lines,
    "c.yaml": read_settings,
    "0.chunk": lambda path: list(read_chunk(path)),
    "authorized": lambda path: AllowList(path).grants(),
    "a.csv": lambda path: read_table(path, 2),
}


@pytest.mark.parametrize("kind", [*KINDS, "hollow"])
@pytest.mark.parametrize("name", READERS)
def test_only_regular_files_of_limited_size_are_read(tmp_path, name, kind):
    path = tmp_path / name
    if kind == "hollow":
        with path.open("wb") as file:
            file.truncate(10**12)
    else:
        special(path, kind)
    with pytest.raises(ShareError) as error:
        READERS[name](path)
    assert name in str(error.value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_special_file_in_a_room_cache_is_refused(tmp_path, kind):
    special(tmp_path / "room.json", kind)
    with pytest.raises(DataError, match="not a complete room"):
        load_room(tmp_path)
    special(tmp_path / "plain.json", kind)
    with pytest.raises(ShareError):
        open_renderer(tmp_path)


@pytest.mark.parametrize("kind", ["pipe", "device", "socket"])
def test_a_special_file_instead_of_a_growing_file_is_ignored(tmp_path, kind):
    special(tmp_path / "odom.tum", kind)
    assert GrowingFile(tmp_path / "odom.tum").new_lines() == []


# ------------------------------------------------------------------ reports of others in ours


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "a/../../secret.png"])
def test_a_report_embeds_only_its_own_pictures(tmp_path, name):
    (tmp_path / "secret.png").write_bytes(b"secret")
    (tmp_path / "out").mkdir()
    with pytest.raises(DataError, match="is not a file name below"):
        html_page("x", f"![a picture]({name})", tmp_path / "out")


@pytest.mark.parametrize("kind", KINDS)
def test_a_report_section_that_is_a_special_file_is_refused(tmp_path, kind):
    special(tmp_path / "sweep.md", kind)
    with pytest.raises(UsageError):
        read_section(tmp_path, 1)


# ------------------------------------------------------------------ what is written


def test_pictures_replace_a_link_and_are_whole(tmp_path, monkeypatch):
    precious = tmp_path / "precious"
    precious.write_text("dear")
    for link in (os.symlink, os.link):
        path = tmp_path / f"{link.__name__}.png"
        link(precious, path)
        draw_bars(path, {"a": {"b": [1.0]}}, ["c"], "cm")
        assert not path.is_symlink() and path.read_bytes().startswith(b"\x89PNG")
        assert precious.read_text() == "dear"

    class Broken:
        def savefig(self, file: io.BytesIO, **_: object) -> None:
            file.write(b"half")
            raise MemoryError

    monkeypatch.setattr(pyplot, "close", lambda figure: None)
    with pytest.raises(MemoryError):
        charts.save_png(Broken(), path, 100)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["link.png", "precious", "symlink.png"]
