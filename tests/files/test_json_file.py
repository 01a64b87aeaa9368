"""JSON files of our commands: intact, incomplete and damaged."""

import pytest

from share.errors import DataError
from share.files.json_file import read_json, read_json_lines


def test_written_json_is_read_back(tmp_path):
    path = tmp_path / "report.json"
    path.write_text('{"frames": 3, "of": {"a": [1, 2]}}')
    assert read_json(path) == {"frames": 3, "of": {"a": [1, 2]}}


@pytest.mark.parametrize("text", ["", "{", '{"a": 1} x', "[1]", "3"])
def test_json_other_than_an_object_is_refused(tmp_path, text):
    path = tmp_path / "report.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"report\.json: is damaged"):
        read_json(path)


def test_a_missing_or_binary_json_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"report\.json: cannot be read: No such file"):
        read_json(tmp_path / "report.json")
    (tmp_path / "report.json").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(DataError, match=r"report\.json: is not a text file"):
        read_json(tmp_path / "report.json")


def test_an_incomplete_last_line_is_ignored(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text('{"event": "a"}\n{"event": "b"}\n{"even')
    assert read_json_lines(path) == [{"event": "a"}, {"event": "b"}]
    path.write_text('{"event"')
    assert read_json_lines(path) == []


def test_a_damaged_line_is_named(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text('{"event": "a"}\n{"event": \n{"event": "c"}\n')
    with pytest.raises(DataError, match=r"events\.jsonl, line 2: is damaged"):
        read_json_lines(path)
