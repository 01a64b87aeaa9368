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
_EXPORT = re.compile(r"^export (?=(?:const|class|function) (\w+))", re.MULTILINE)
_OTHER = re.compile(r"^\s*(?:import|export)\b.*|\bimport\.meta\b", re.MULTILINE)


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
    for _, other in _IMPORT.findall(files[name]):
        if other in parts:
            continue
        _add_imported(other, files, parts, (*above, name))
        exported = ", ".join(_EXPORT.findall(files[other]))
        body = _body(other, files[other], keeps_exports=False)
        parts[other] = f"const {_variable(other)} = (() => {{\n{body}\nreturn {{ {exported} }};\n}})();\n"


def _body(name: str, text: str, keeps_exports: bool) -> str:
    text = _IMPORT.sub(lambda found: f"const {found[1].replace(' as ', ': ')} = {_variable(found[2])};", text)
    bare = _EXPORT.sub("", text)
    if other := _OTHER.search(bare):
        raise ValueError(f"{name}: cannot be joined: {other[0].strip()[:100]}")
    return text if keeps_exports else bare


def _variable(name: str) -> str:
    return "module_" + name.removesuffix(".js").replace("-", "_")
