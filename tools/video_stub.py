"""OpenCV's wheel without its video codecs: libraries that are there for the loader and hold nothing.

cv2 is linked with FFmpeg, for VideoCapture and VideoWriter, which SHARE never calls; a library that is linked
must be there all the same. Each is replaced by one with the same name, symbols and symbol versions, whose
functions say so and abort. Saves 32 MB.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable
from pathlib import Path

LINKED = ("libavcodec", "libavformat", "libavutil", "libswscale")
ONLY_THEIRS = ("libswresample", "libvpx", "libcrypto-", "libssl-", "libdrm")  # nobody else asks for them

_SOURCE = """#include <stdio.h>
#include <stdlib.h>
static void gone(void) {{
    fputs("share: video codecs are left out of this frozen program\\n", stderr);
    abort();
}}
{functions}
"""


def symbols(library: Path) -> dict[str, str]:
    """What `library` wants of FFmpeg: version (LIBAVCODEC_62) by symbol."""
    told = subprocess.run(["objdump", "-T", library], capture_output=True, text=True, check=True).stdout
    return {name: version for version, name in re.findall(r"\*UND\*.*\((LIB(?:AV|SW)\w+)\) (\w+)", told)}


def write_stub(path: Path, wanted: Iterable[str], version: str) -> None:
    """In place of the library at `path`. Needs a C compiler, `cc`. Raises subprocess.CalledProcessError."""
    functions = "\n".join(f"void {name}(void) {{ gone(); }}" for name in sorted(wanted))
    source, script = path.with_name("stub.c"), path.with_name("stub.map")
    source.write_text(_SOURCE.format(functions=functions))
    script.write_text(f"{version} {{ global: *; }};\n")
    link = ["-Wl,-soname," + path.name, f"-Wl,--version-script={script}", "-s"]
    try:
        subprocess.run(["cc", "-shared", "-fPIC", "-w", source, *link, "-o", path], check=True)
    finally:
        source.unlink()
        script.unlink()


def without_video(inside: Path) -> None:
    """inside: the `_internal` of a frozen program."""
    wanted = symbols(next((inside / "cv2").glob("cv2*.so")))
    folder = inside / "opencv_python_headless.libs"
    for path in sorted(folder.iterdir()):
        if path.name.startswith(LINKED):
            number = path.name.partition(".so.")[2].partition(".")[0]
            version = f"{path.name.partition('-')[0].upper()}_{number}"
            write_stub(path, (name for name, of in wanted.items() if of == version), version)
        elif path.name.startswith(ONLY_THEIRS):
            path.unlink()
            (inside / path.name).unlink(missing_ok=True)  # a link to it
