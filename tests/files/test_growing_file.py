"""A file that is read while it is written."""

from share.files.line_file import GrowingFile


def test_each_whole_line_comes_once(tmp_path):
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


def test_it_is_the_same_file_once_it_has_its_name_and_an_earlier_one_is_not(tmp_path):
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
