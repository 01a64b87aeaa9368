"""The pages agree with commands, settings and files."""

from __future__ import annotations

import ast
import re
import runpy
import textwrap
from pathlib import Path
from typing import Any

import click
import pytest

from share.cli.main import cli
from share.cli.verbosity import VerboseOption

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *ROOT.glob("*/README.md")])
CITING = [page for page in PAGES if "results" not in page.parts]
NOT_MODULES = {"share.x.y", "share.rig"}  # an example; a record in MCAP files
NOT_OURS = {
    "AprilGrid",
    "ChArUco",
    "BasaltVIO",
    "CameraInfo",
    "CompressedImage",
    "MemoryError",
    "RecursionError",
    "ValueError",
    "PoseStamped",
    "PoseWithCovariance",
    "PointCloud2",
    "FileStorage",
}
TOOL: dict[str, Any] = runpy.run_path(str(ROOT / "tools" / "config_table.py"))
COMMON_LINE = re.compile(r"^Also: (.+(?:\n.+)*)", re.MULTILINE)
COMMANDS = (DOCS / "lookup" / "commands.md").read_text()


def commands(group: click.Group, name: str = "share") -> dict[str, click.Command]:
    """All that do something, by their full name."""
    out = {}
    for word in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), word)
        assert command is not None
        full = f"{name} {word}"
        out |= commands(command, full) if isinstance(command, click.Group) else {full: command}
    return out


def documented() -> dict[str, str]:
    """The sections of docs/lookup/commands.md that are about one command, by its full name."""
    parts = re.split(r"^## `(share [a-z -]+)`\n", COMMANDS, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def options(command: click.Command) -> set[str]:
    return {
        max(p.opts, key=len)
        for p in command.params
        if isinstance(p, click.Option) and not isinstance(p, VerboseOption)  # which every command has
    }


def prose(text: str) -> str:
    """The text without fenced code."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def links(text: str) -> list[str]:
    """Targets of Markdown links and of src, srcset and href."""
    text = re.sub(r"`[^`\n]*`", "", prose(text))
    return re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|srcset|href)="([^"]+)"', text)


def anchors(page: Path) -> set[str]:
    """As GitHub makes them of headings."""
    headings = re.findall(r"^#+ (.+)$", prose(page.read_text()), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_configuration_page_is_up_to_date() -> None:
    _head, marker, table = TOOL["PAGE"].read_text().partition(TOOL["MARKER"])
    assert marker, f"no line {TOOL['MARKER']!r}"
    made = TOOL["page"](TOOL["sections"](TOOL["SOURCE"].read_text()))
    assert table.strip() == made.strip(), "run `python tools/config_table.py --write`"


def test_every_setting_has_a_description() -> None:
    found = TOOL["sections"](TOOL["SOURCE"].read_text())
    assert [f"{s.name}.{row.name}" for s in found for row in s.settings if not row.meaning] == []
    assert [s.name for s in found if not s.about] == []


def test_table_has_every_key_and_its_default() -> None:
    from share.config import Config
    from share.plain_data import to_mapping

    found = TOOL["sections"](TOOL["SOURCE"].read_text())
    reported = {s.name: {row.name: row.default.strip("'") for row in s.settings} for s in found}
    made = to_mapping(Config()).items()
    assert reported == {s: {k: "null" if v is None else str(v) for k, v in keys.items()} for s, keys in made}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_have_targets(page: Path) -> None:
    for target in links(page.read_text()):
        if re.match(r"https?://", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}"


def test_every_page_of_docs_can_be_reached_from_the_readme() -> None:
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page not in reached:
            reached.add(page)
            targets = [t.partition("#")[0] for t in links(page.read_text())]
            waiting += [(page.parent / t).resolve() for t in targets if t.endswith(".md") and "://" not in t]
    assert [str(p.relative_to(ROOT)) for p in DOCS.rglob("*.md") if p not in reached] == [
        "docs/index.md"  # the site's front page; on a code host the README is
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_fenced_code_has_a_language_and_none_is_indented(page: Path) -> None:
    text = page.read_text()
    openings = re.findall(r"^```(.*)$", text, flags=re.MULTILINE)
    assert len(openings) % 2 == 0 and all(openings[::2]) and not any(openings[1::2])
    assert re.findall(r"\n\n( {4}\S.*)", prose(text)) == []


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    """The texts of share/ and tools/, by module name."""
    files = [p for folder in ("share", "tools") for p in (ROOT / folder).rglob("*.py")]
    names = {p: ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in files}
    return {name: path.read_text() for path, name in names.items()}


def defines(text: str, name: str) -> bool:
    """Whether a line of this source defines a class, function, variable or field of that name."""
    return name in text and bool(
        re.search(rf"^\s*(?:(?:class|def) {name}\b|(?:self\.)?{name}(?:: | = ))", text, re.MULTILINE)
    )


@pytest.mark.parametrize("page", CITING, ids=lambda p: str(p.relative_to(ROOT)))
def test_modules_classes_and_attributes_that_a_page_cites_exist(page: Path, sources: dict[str, str]) -> None:
    code = re.findall(r"`([^`\n]+)`", prose(page.read_text()))
    for name in {c for c in code if re.fullmatch(r"share(\.\w+)+", c)} - NOT_MODULES:
        module, _, last = name.rpartition(".")
        assert name in sources or defines(sources.get(module, ""), last), f"{page.name}: {name}"
    for path in {c for c in code if re.fullmatch(r"(share|tools|tests)/[a-z\d_/.-]+", c)}:
        assert (ROOT / path).exists(), f"{page.name}: {path}"
    for cited in {c for c in code if re.fullmatch(r"[A-Z][a-z]+[A-Z]\w*(\.[a-z]\w+)?", c)} - NOT_OURS:
        owner, _, attribute = cited.partition(".")
        homes = [text for text in sources.values() if defines(text, owner)]
        assert homes, f"{page.name}: {cited}"
        assert not attribute or any(defines(text, attribute) for text in homes), f"{page.name}: {cited}"


def test_the_site_lists_every_page() -> None:
    """Needs no MkDocs; `make docs` builds the site and checks its links strictly."""
    listed = re.findall(
        r"^ +- (?:.+: )?([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), flags=re.MULTILINE
    )
    pages = [p.relative_to(DOCS) for p in DOCS.rglob("*.md")]
    assert sorted(listed) == sorted(str(p) for p in pages if "results" not in p.parts)


def test_every_picture_of_docs_is_shown_on_a_page() -> None:
    text = "".join(page.read_text() for page in PAGES)
    pictures = [p for ext in ("jpg", "png", "svg", "webp") for p in DOCS.rglob(f"*.{ext}")]
    assert pictures and [p.name for p in pictures if p.name not in text] == []


def test_commands_page_has_every_command_and_no_other() -> None:
    assert set(documented()) == set(commands(cli))


@pytest.mark.parametrize("name", sorted(commands(cli)))
def test_commands_page_has_every_option_and_no_other(name: str) -> None:
    section = documented()[name]
    rows = re.findall(r"^\| `[^|]*?(--[a-z-]+)", section, flags=re.MULTILINE)
    common = [o for line in COMMON_LINE.findall(section) for o in re.findall(r"`(--[a-z-]+)`", line)]
    assert sorted(rows + common) == sorted(options(commands(cli)[name]))
    described = COMMANDS.partition("## Common options\n")[2].partition("\n## ")[0]
    assert [
        option for option in common if not re.search(rf"^\| .*`{option}\b", described, re.MULTILINE)
    ] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_examples_use_options_that_exist(page: Path) -> None:
    """Every fenced line that is a command, after a prompt or not; `share agent: …` is one that answers."""
    known = commands(cli)
    text = page.read_text().replace("\\\n", " ")
    code = "\n".join(re.findall(r"^```\w+\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL))
    for line in re.findall(r"^(?:\w*\$ )?(share (?!\w+: ).+)$", code, flags=re.MULTILINE):
        line, _, of_edge = re.split(r"\s{2,}#|\s&", line)[0].partition(" -- ")
        assert not set(re.findall(r"--[a-z-]+", of_edge)) - options(known["share edge"]), line
        name = max((n for n in known if f"{line} ".startswith(f"{n} ")), key=len, default=None)
        assert name or re.match(r"share (--|[a-z]+ --help)", line), f"{page.name}: {line}"
        if name:
            wrong = set(re.findall(r"(?<= )--[a-z-]+", line)) - options(known[name]) - {"--help"}
            assert not wrong, f"{page.name}: {line}"


@pytest.mark.parametrize("name", sorted(commands(cli)))
def test_help_explains_each_choice(name: str) -> None:
    command = commands(cli)[name]
    for option in command.params:
        if isinstance(option, click.Option) and isinstance(option.type, click.Choice):
            text = f"{command.help} {option.help}".partition("  [default")[0]
            unexplained = [word for word in option.type.choices if not re.search(rf"\b{word}\b", text)]
            assert not unexplained, f"{option.opts}: {unexplained}"


@pytest.mark.parametrize("name", sorted(commands(cli)))
def test_help_has_short_names_of_numbers_and_says_what_may_be_repeated(name: str) -> None:
    command = commands(cli)[name]
    given = [option for option in command.params if isinstance(option, click.Option)]
    assert [one.opts for one in given if one.metavar is None and "range" in one.type.name] == []
    named_by_all = "[NAME=]" if "with [NAME=] may be repeated" in f"{command.help}" else "\n"
    repeated = [option for option in given if option.multiple and named_by_all not in f"{option.metavar}"]
    assert [option.opts for option in repeated if "may be repeated" not in f"{option.help}".lower()] == []


def test_help_of_emulate_has_every_scene() -> None:
    from share.lab.emulate.world.scenes import SCENES

    text = commands(cli)["share emulate"].help or ""
    assert [name for name in SCENES if not re.search(rf"\b{name}\b", text)] == []


PACKAGES = sorted(path.parent for path in (ROOT / "share").rglob("__init__.py"))


def introduction(package: Path) -> str:
    """The package's docstring."""
    return ast.get_docstring(ast.parse((package / "__init__.py").read_text())) or ""


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_package_says_what_it_is(package: Path, sources: dict[str, str]) -> None:
    """The modules and names exist that its docstring cites, in backticks or first in a row."""
    text = introduction(package)
    assert text
    sections = TOOL["sections"](TOOL["SOURCE"].read_text())
    settings = {f"{section.name}.{row.name}" for section in sections for row in section.settings}
    cited = re.findall(r"`([^`\n]+)`|^ {4}(\w+)  ", text, re.MULTILINE)
    names = {one or other for one, other in cited} - settings
    for name in {one.removesuffix(".py") for one in names if re.fullmatch(r"[a-z]\w*(\.\w+)*", one)}:
        module, path = ".".join(package.relative_to(ROOT).parts), name.split(".")
        if path[0] == "share":
            module = path.pop(0)
        while path and f"{module}.{path[0]}" in sources:
            module = f"{module}.{path.pop(0)}"
        assert all(defines(sources[module], one) for one in path), name


@pytest.mark.long
def test_the_example_of_the_package_runs(plain_session: Path) -> None:
    (code,) = re.findall(
        r"^ {4}from .*?(?=\n\n[A-Z])", introduction(ROOT / "share"), re.MULTILINE | re.DOTALL
    )
    names: dict[str, Any] = {}
    exec(textwrap.dedent(code).replace("room1/ann", str(plain_session / "ar1")), names)
    assert [pose.T_odom_body.shape for pose in names["poses"]] == [(4, 4)] * 45
