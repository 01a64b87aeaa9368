"""docs/start/first-room.md is read as people read it."""

from __future__ import annotations

from dataclasses import replace

from machines import Machine
from page import blocks, renewed

PAGE = """# Title

```bash
git clone somewhere
```

Then:

```console
laptop$ one \\
--more
shown

shown below an empty line
robot$ two
```

Text.

```console
headset$ three
```
"""


def test_what_is_typed_and_shown_on_which_machine() -> None:
    first, second = blocks(PAGE)
    one, two = first.steps
    assert (one.machine, one.command) == ("laptop", "one \\\n--more")
    assert one.shown == ("shown", "", "shown below an empty line")
    assert (two.machine, two.command, two.shown) == ("robot", "two", ())
    assert [step.command for step in second.steps] == ["three"]


def test_what_was_shown_is_put_there_and_nothing_else_changes() -> None:
    first, second = blocks(PAGE)
    assert renewed(PAGE, [(first, first.steps), (second, second.steps)]) == PAGE
    quiet = [(first, [type(step)(step.machine, step.typed) for step in first.steps])]
    assert renewed(PAGE, quiet) == PAGE.replace("shown\n\nshown below an empty line\n", "")


def test_a_page_that_leaves_lines_out_leaves_out_those_of_the_next_walk() -> None:
    page = PAGE.replace("shown\n\nshown below an empty line", "table\n…\nend")
    first, _ = blocks(page)
    one, two = first.steps
    assert one.shown == ("table", "…", "end")
    longer = replace(one, shown=("head", "a", "b", "c", "tail"))
    assert renewed(page, [(first, [longer, two])]) == page.replace("table", "head").replace("end\n", "tail\n")
    short = replace(one, shown=("head", "tail"))
    assert "head\ntail\nrobot$ two" in renewed(page, [(first, [short, two])])


def test_machines_are_shells_with_jobs_and_copy_from_each_other(tmp_path) -> None:
    laptop, robot = Machine("laptop", tmp_path), Machine("robot", tmp_path)
    try:
        assert laptop.run("mkdir -p a/b; echo 'two words' >a/b/c", 10) == (0, [])
        assert robot.run("scp -r laptop:a/b .", 10) == (0, [])
        assert robot.run("cat b/c; false", 10) == (1, ["two words"])
        assert laptop.run("sleep 100 &", 10)[0] == 0
        assert laptop.run("kill %1; wait %1", 10)[0] == 128 + 15
        assert robot.run("pwd", 10) == (0, [str(tmp_path / "robot")])
    finally:
        laptop.close()
        robot.close()
