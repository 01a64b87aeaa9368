"""The page in two files."""

from __future__ import annotations

import re

import pytest

from share.headset.page_joining import joined_html, joined_module
from share.headset.page_requests import FOLDER, PageGuard, read_page

PAGE = {one.name: one.read_text() for one in FOLDER.iterdir()}


def test_the_page_is_two_files_and_its_policy_knows_what_is_in_them() -> None:
    files = read_page()
    html, module = (files[path].body.decode() for path in ("/", "/main.js"))
    assert re.findall(r'(?:src|href)="([^"]*)"', html) == ["data:,", "", "main.js"]
    assert not re.search(r"^import\b", module, re.MULTILINE)
    assert re.findall(r"^export .*", module, re.MULTILINE) == [
        'export const app = new App(document.getElementById("view"));'
    ]
    for name in PAGE:
        if name.endswith(".js") and name not in ("main.js", "loading.js"):
            assert module.count(f"const module_{name[:-3].replace('-', '$')} = ") == 1
    policy = PageGuard("https", (), files).headers("127.0.0.1")["Content-Security-Policy"]
    for kind in ("script", "style"):
        assert re.search(rf"{kind}-src 'self' 'sha256-[A-Za-z0-9+/]{{43}}=';", policy)
    assert "unsafe" not in policy


def test_a_module_comes_after_what_it_imports_once() -> None:
    files = {
        "main.js": 'import { a as b } from "./x-y.js";\n'
        'import { z } from "./z.js";\nexport const c = b + z;\n',
        "x-y.js": 'import { z } from "./z.js";\nconst hidden = 1;\nexport function a() { return z; }\n',
        "z.js": "const hidden = 2;\nexport class Z {}\nexport const z = hidden;\n",
    }
    assert joined_module("main.js", files) == (
        "const module_z = (() => {\nconst hidden = 2;\nclass Z {}\nconst z = hidden;\n"
        "\nreturn { Z, z };\n})();\n"
        "const module_x$y = (() => {\nconst { z } = module_z;\nconst hidden = 1;\n"
        "function a() { return z; }\n\nreturn { a };\n})();\n"
        "const { a: b } = module_x$y;\nconst { z } = module_z;\nexport const c = b + z;\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        'import "./z.js";',
        'import * as z from "./z.js";',
        'import z from "./z.js";',
        "import { z } from './z.js';",
        "export default 1;",
        "export async function f() {}",
        "export { z };",
        "export let z = 1;",
        "const here = import.meta.url;",
    ],
)
def test_what_is_not_known_is_not_guessed(text: str) -> None:
    with pytest.raises(ValueError, match=r"one\.js: cannot be joined: "):
        joined_module("one.js", {"one.js": text, "z.js": ""})
    with pytest.raises(ValueError, match="imports itself"):
        joined_module("a.js", {"a.js": 'import { b } from "./b.js";', "b.js": 'import { a } from "./a.js";'})


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("export const b = 1, a = 2;", r"it imports a, which z\.js does not export"),
        ("export const b = 1;", r"it imports a, which z\.js does not export"),
        ("export class a$ {}", r"z\.js: cannot be joined: export class a\$"),
        ("\ufeffexport const a = 1;", r"z\.js: cannot be joined: it begins with a byte order mark"),
    ],
)
def test_what_would_be_undefined_is_said(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        joined_module("one.js", {"one.js": 'import { a as c } from "./z.js";', "z.js": text})


@pytest.mark.parametrize(
    "text",
    [
        "/* not yet:\nexport const b = 1;\n*/",
        "const text = `\nexport const b = 1;\n`;",
        '/*\nimport { b } from "./y.js";\n*/',
        'const a1 = "/*"; /*\n  export const b = 1; */',
    ],
)
def test_a_comment_exports_and_imports_nothing(text: str) -> None:
    files = {
        "x.js": 'import { a } from "./z.js";',
        "y.js": "export const b = 1;",
        "z.js": f"{text}\nexport const a = 1;",
    }
    with pytest.raises(ValueError, match=r"z\.js: cannot be joined: in a comment or text: (im|ex)port"):
        joined_module("x.js", files)
    aside = "// it's `so\nexport const a = 1; /* export\n it */\nexport const b = '/* `';\n"
    assert joined_module("y.js", {"y.js": aside}) == aside


def test_modules_with_names_alike_stay_apart() -> None:
    files = {
        "main.js": 'import { a } from "./a-b.js";\nimport { b } from "./a_b.js";\n',
        "a-b.js": "export const a = 1;\n",
        "a_b.js": "export const b = 1;\n",
    }
    names = re.findall(r"^const (module_\S+) = ", joined_module("main.js", files), re.MULTILINE)
    assert len(set(names)) == 2


def test_style_and_small_scripts_are_in_the_html() -> None:
    html = '<link rel="stylesheet" href="a.css"><script src="b.js"></script><script type="module" src="m.js">'
    files = {"a.css": "p { }", "b.js": "1 < 2;\n"}
    assert (
        joined_html(html, files)
        == '<style>p { }</style><script>1 < 2;\n</script><script type="module" src="m.js">'
    )
