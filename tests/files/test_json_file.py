"""Files that our commands wrote, whole, half and spoiled."""

import pytest

from share.errors import DataError
from share.files.json_file import read_json, read_json_lines


def test_what_was_written_is_read(tmp_path):
    path = tmp_path / "report.json"
    path.write_text('{"frames": 3, "of": {"a": [1, 2]}}')
    assert read_json(path) == {"frames": 3, "of": {"a": [1, 2]}}


@pytest.mark.parametrize("text", ["", "{", '{"a": 1} x', "[1]", "3"])
def test_what_is_no_object_is_named(tmp_path, text):
    path = tmp_path / "report.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"report\.json: is damaged"):
        read_json(path)


def test_what_is_not_there_or_not_text_is_named(tmp_path):
    with pytest.raises(DataError, match=r"report\.json: cannot be read: No such file"):
        read_json(tmp_path / "report.json")
    (tmp_path / "report.json").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(DataError, match=r"report\.json: is not a text file"):
        read_json(tmp_path / "report.json")


def test_a_line_that_is_still_being_written_is_left_out(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text('{"event": "a"}\n{"event": "b"}\n{"even')
    assert read_json_lines(path) == [{"event": "a"}, {"event": "b"}]
    path.write_text('{"event"')
    assert read_json_lines(path) == []


def test_a_spoiled_line_is_named(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text('{"event": "a"}\n{"event": \n{"event": "c"}\n')
    with pytest.raises(DataError, match=r"events\.jsonl, line 2: is damaged"):
        read_json_lines(path)
