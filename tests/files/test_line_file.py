"""A file is read while another process writes it."""

from share.files.line_file import GrowingFile


def test_each_complete_line_is_yielded_once(tmp_path):
    path = tmp_path / "events.jsonl"
    file = GrowingFile(path)
    assert file.new_lines() == []
    with path.open("w") as growing:
        growing.write("one\ntw")
        growing.flush()
        assert file.new_lines() == ["one"]
        growing.write("o\nthree\n")
        growing.flush()
        assert file.new_lines() == ["two", "three"]
    assert file.new_lines() == []


def test_a_renamed_file_is_continued_and_an_older_one_ignored(tmp_path):
    path, partial = tmp_path / "odom.tum", tmp_path / "odom.tum.partial"
    path.write_text("of an earlier run\n" * 9)
    file = GrowingFile(path, partial)
    assert file.new_lines() == []
    partial.write_text("a\nb\n")
    assert file.new_lines() == ["a", "b"]
    partial.write_text("a\nb\nc\n")
    partial.rename(path)
    assert file.new_lines() == ["c"]
    assert file.new_lines() == []
