"""Small shared libraries in place of large ones: same name and symbols, but hollow, or forwarding.

A linked library must exist for the loader, used or not. Needs a C compiler, `cc`, and binutils.
"""

from __future__ import annotations

import platform
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

_ABORTS = """#include <stdio.h>
#include <stdlib.h>
#define BODY {{ fputs("share: {library} is left out of this frozen program\\n", stderr); abort(); }}
"""
_ANSWERS_NOTHING = "#define BODY {{ return 0; }}\n"
_JUMP = {"x86_64": "jmp {}@PLT", "aarch64": "b {}"}


def exported(library: Path) -> dict[str, str]:
    """Return the exported symbols of `library` with their versions, "" without one."""
    return {name: "" if version == "Base" else version for name, version in _table(library, defined=True)}


def wanted(users: Iterable[Path], library: Path) -> dict[str, str]:
    """Return the exports of `library` that `users` import."""
    asked = {name for user in users for name, _ in _table(user, defined=False)}
    return {name: version for name, version in exported(library).items() if name in asked}


def needed(binary: Path) -> list[str]:
    """Return the names of the libraries that it is linked with."""
    return re.findall(r"NEEDED\s+(\S+)", _output("objdump", "-p", binary))


def write_hollow(path: Path, symbols: Mapping[str, str], answers: bool = False) -> None:
    """Write a hollow library in place of `path`: every function reports that it is left out and aborts
    or, if `answers`, returns 0. symbols: with versions. Raises subprocess.CalledProcessError."""
    head = (_ANSWERS_NOTHING if answers else _ABORTS).format(library=path.name.partition("-")[0])
    functions = "".join(f"long {name}(void) BODY\n" for name in sorted(symbols))
    _build(path, head + functions, symbols)


def write_forward(path: Path, symbols: Iterable[str], prefix: str, to: Path) -> None:
    """Write a library in place of `path` whose functions jump to those of the library `to` with names
    prefixed by `prefix`. Raises subprocess.CalledProcessError, KeyError on an unsupported processor."""
    jump = _JUMP[platform.machine()]
    lines = (
        rf'".globl {name}\n.type {name},%function\n{name}: {jump.format(prefix + name)}\n"'
        for name in sorted(symbols)
    )
    source = "__asm__(\n" + "\n".join([r'".text\n"', *lines]) + "\n);\n"
    where = f"$ORIGIN:$ORIGIN/../{to.parent.name}"
    _build(path, source, {}, ["-Wl,--no-as-needed", to, f"-Wl,-rpath,{where}"])


def _build(path: Path, source: str, versions: Mapping[str, str], link: Sequence[str | Path] = ()) -> None:
    code, script = path.with_name("stub.c"), path.with_name("stub.map")
    groups: dict[str, list[str]] = {}
    for name, version in versions.items():
        if version:
            groups.setdefault(version, []).append(name)
    code.write_text(source)
    script.write_text("".join(f"{version} {{ {'; '.join(names)}; }};\n" for version, names in groups.items()))
    options = ["-Wl,-soname," + path.name, "-s", *([f"-Wl,--version-script={script}"] if groups else [])]
    try:
        path.unlink(missing_ok=True)
        subprocess.run(["cc", "-shared", "-fPIC", "-w", code, *options, *link, "-o", path], check=True)
    finally:
        code.unlink()
        script.unlink()


def _table(binary: Path, defined: bool) -> list[tuple[str, str]]:
    """Return (name, version) of dynamic symbols. objdump's line: address, flags, section, tab, size, version
    (in brackets if it is not the default or another library's), name."""
    found = []
    for line in _output("objdump", "-T", binary).splitlines():
        left, tab, right = line.partition("\t")
        if tab and (left.split()[-1] != "*UND*") == defined:
            _, *version, name = right.split()
            found.append((name, version[0].strip("()") if version else ""))
    return found


def _output(*command: str | Path) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout
