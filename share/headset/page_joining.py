"""The page in two files instead of twenty: each file is a connection, of which one address has not enough for
many headsets, and one that does not come leaves no page.

Its HTML gets its style and its small scripts into it; its module gets all that it imports, each as a function
that is called once. Only the forms of `import` and `export` that the page has are known.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping

_STYLE = re.compile(r'<link rel="stylesheet" href="([\w-]+\.css)">')
_SCRIPT = re.compile(r'<script src="([\w-]+\.js)"></script>')
_INLINE = re.compile(rb"<(style|script)>(.*?)</\1>", re.DOTALL)
_IMPORT = re.compile(r'^import (\{[\w, ]+\}) from "\./([\w-]+\.js)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:const|class|function) (\w+)(?![\w$]))", re.MULTILINE)
_OTHER = re.compile(r"^\s*(?:import|export)\b.*|\bimport\.meta\b", re.MULTILINE)
# What may hold a line that only looks like one of these; strings of one line do not.
_ASIDE = re.compile(
    r"""//[^\n]*|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|(/\*.*?(?:\*/|\Z)|`(?:\\.|[^`\\])*(?:`|\Z))""",
    re.DOTALL,
)


def joined_html(html: str, files: Mapping[str, str]) -> str:
    """Return a page with its style and its classic scripts in it. files: by name. Raises KeyError."""
    html = _STYLE.sub(lambda found: f"<style>{files[found[1]]}</style>", html)
    return _SCRIPT.sub(lambda found: f"<script>{files[found[1]]}</script>", html)


def inline_sources(html: bytes, kind: str) -> list[str]:
    """Return what lets the parts of a page run that are in its HTML, in the words of a content policy. kind:
    `style` or `script`."""
    texts = [text for tag, text in _INLINE.findall(html) if tag == kind.encode()]
    return [f"'sha256-{base64.b64encode(hashlib.sha256(text).digest()).decode()}'" for text in texts]


def joined_module(name: str, files: Mapping[str, str]) -> str:
    """Return a module with all that it imports in it; what it exports it still does. files: modules by name.
    Raises ValueError for what cannot be joined, KeyError for a module that is not there."""
    parts: dict[str, str] = {}
    _add_imported(name, files, parts, ())
    return "".join([*parts.values(), _body(name, files[name], keeps_exports=True)])


def _add_imported(name: str, files: Mapping[str, str], parts: dict[str, str], above: tuple[str, ...]) -> None:
    """Add what a module imports, each before what needs it."""
    if name in above:
        raise ValueError(f"{name} imports itself, by {above[-1]}")
    for names, other in _IMPORT.findall(files[name]):
        exports = _EXPORT.findall(files[other])
        if other not in parts:
            _add_imported(other, files, parts, (*above, name))
            body = _body(other, files[other], keeps_exports=False)
            text = f"{{\n{body}\nreturn {{ {', '.join(exports)} }};\n}}"
            parts[other] = f"const {_variable(other)} = (() => {text})();\n"
        wanted = {one.split(" as ")[0].strip() for one in names[1:-1].split(",")}
        if missing := wanted - {"", *exports}:
            text = f"{', '.join(sorted(missing))}, which {other} does not export by a line of its own"
            raise ValueError(f"{name}: cannot be joined: it imports {text}")


def _body(name: str, text: str, keeps_exports: bool) -> str:
    if text.startswith("\ufeff"):
        raise ValueError(f"{name}: cannot be joined: it begins with a byte order mark")
    for aside in _ASIDE.findall(text):
        if apparent := _OTHER.search(aside):
            raise ValueError(f"{name}: cannot be joined: in a comment or text: {apparent[0].strip()[:100]}")
    text = _IMPORT.sub(lambda found: f"const {found[1].replace(' as ', ': ')} = {_variable(found[2])};", text)
    bare = _EXPORT.sub("", text)
    if other := _OTHER.search(bare):
        raise ValueError(f"{name}: cannot be joined: {other[0].strip()[:100]}")
    return text if keeps_exports else bare


def _variable(name: str) -> str:
    return "module_" + name.removesuffix(".js").replace("-", "$")  # so that a-b.js is another than a_b.js
