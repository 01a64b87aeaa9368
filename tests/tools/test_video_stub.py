"""Libraries that stand for FFmpeg in the frozen program: they load, and who calls them is told."""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"

pytestmark = pytest.mark.skipif(
    not (shutil.which("cc") and shutil.which("objdump")), reason="needs a C compiler and binutils"
)


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("video_stub")


def test_what_cv2_wants_is_of_ffmpeg_and_has_a_version(tool):
    cv2 = importlib.util.find_spec("cv2")
    assert cv2 is not None and cv2.origin is not None
    wanted = tool.symbols(next(Path(cv2.origin).parent.glob("cv2*.so")))
    assert wanted["avcodec_open2"].startswith("LIBAVCODEC_")
    assert wanted["sws_scale"].startswith("LIBSWSCALE_")
    assert {version.partition("_")[0] for version in wanted.values()} == {
        *("LIBAVCODEC", "LIBAVFORMAT", "LIBAVUTIL", "LIBSWSCALE")
    }


def test_a_stub_loads_has_its_version_and_says_what_it_is_when_called(tool, tmp_path):
    library = tmp_path / "libavcodec-1234.so.62.1"
    tool.write_stub(library, ["avcodec_open2", "av_packet_free"], "LIBAVCODEC_62")
    assert list(tmp_path.iterdir()) == [library]
    told = subprocess.run(["objdump", "-T", library], capture_output=True, text=True, check=True).stdout
    for name in ("avcodec_open2", "av_packet_free"):
        assert any("LIBAVCODEC_62" in line and name in line for line in told.splitlines())
    call = f"import ctypes; ctypes.CDLL({str(library)!r}).avcodec_open2()"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True)
    assert done.returncode == -6  # SIGABRT
    assert done.stderr == "share: video codecs are left out of this frozen program\n"
