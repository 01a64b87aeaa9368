"""Small libraries in place of large ones in the frozen program."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"

pytestmark = pytest.mark.skipif(
    not all(map(shutil.which, ("cc", "objdump", "strip"))), reason="needs a C compiler and binutils"
)


@pytest.fixture
def stubs(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("stub_library")


@pytest.fixture
def slimming(stubs):
    return importlib.import_module("slim")


def build(path: Path, code: str, *link: str | Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    command = ["cc", "-shared", "-fPIC", "-g", "-x", "c", "-", f"-Wl,-soname,{path.name}", "-o", path]
    subprocess.run([*command, "-x", "none", *link], input=code, text=True, check=True)
    return path


def site_packages() -> Path:
    found = importlib.util.find_spec("cv2")
    assert found is not None and found.origin is not None
    return Path(found.origin).parents[1]


def test_ffmpeg_symbols_of_cv2_have_versions(stubs):
    site = site_packages()
    users = list(site.glob("cv2/cv2*.so"))
    wanted = stubs.wanted(users, next(site.glob("opencv_python_headless.libs/libavcodec-*")))
    assert wanted["avcodec_open2"].startswith("LIBAVCODEC_")
    assert "avcodec_version" not in wanted or wanted["avcodec_version"] == wanted["avcodec_open2"]


def test_scipy_provides_the_lapack_symbols_of_cv2(stubs):
    """Else its OpenBLAS cannot be led to SciPy's, and `make freeze` says so."""
    site = site_packages()
    (openblas,) = site.glob("opencv_python_headless.libs/libopenblasp*")
    (theirs,) = site.glob("scipy.libs/libscipy_openblas-*")
    wanted = stubs.wanted(site.glob("cv2/cv2*.so"), openblas)
    assert "dgesv_" in wanted
    assert {"scipy_" + name for name in wanted} <= stubs.exported(theirs).keys()


def test_stub_library_has_versions_and_reports_calls(stubs, tmp_path):
    library = tmp_path / "libavcodec-1234.so.62.1"
    wanted = {"avcodec_open2": "LIBAVCODEC_62", "av_packet_free": "LIBAVCODEC_62"}
    stubs.write_hollow(library, wanted)
    assert list(tmp_path.iterdir()) == [library]
    exported = stubs.exported(library)
    assert {name: exported[name] for name in wanted} == wanted
    call = f"import ctypes; ctypes.CDLL({str(library)!r}).avcodec_open2()"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True)
    assert done.returncode == -6  # SIGABRT
    assert done.stderr == "share: libavcodec is left out of this frozen program\n"


def test_silent_stub_returns_null(stubs, tmp_path):
    library = tmp_path / "libaom-1.so.3"
    stubs.write_hollow(library, {"aom_codec_av1_dx": ""}, answers=True)
    call = ctypes.CDLL(str(library)).aom_codec_av1_dx
    call.restype = ctypes.c_void_p
    assert call() is None


def test_forwarded_function_gets_all_arguments(stubs, tmp_path):
    code = """
    double scipy_sum_(double *a, int *n) {double s = 0; for (int i = 0; i < *n; i++) s += a[i]; return s;}
    long scipy_many(long a, long b, long c, long d, long e, long f, long g, long h) {return 10 * g + h;}
    """
    theirs = build(tmp_path / "scipy.libs" / "libscipy_openblas-1.so", code)
    ours = tmp_path / "cv.libs" / "libopenblasp-2.so"
    ours.parent.mkdir()
    stubs.write_forward(ours, ["sum_", "many"], "scipy_", theirs)
    loaded = ctypes.CDLL(str(ours))
    loaded.sum_.restype = ctypes.c_double
    values = (ctypes.c_double * 3)(1.5, 2.0, 4.0)
    assert loaded.sum_(values, ctypes.byref(ctypes.c_int(3))) == 7.5
    assert loaded.many(*map(ctypes.c_long, (1, 2, 3, 4, 5, 6, 7, 8))) == 78


def test_libraries_needed_only_by_stubs_are_removed(slimming, tmp_path):
    deep = build(tmp_path / "a.libs" / "libdeep-1.so", "int deep(void) {return 1;}")
    middle = build(
        tmp_path / "a.libs" / "libmiddle-1.so", "int deep(void); int middle(void) {return deep();}", deep
    )
    build(tmp_path / "pkg" / "module.so", "int middle(void); int top(void) {return middle();}", middle)
    slimming.remove_orphans(tmp_path)
    assert deep.exists()
    slimming.write_hollow(middle, slimming.wanted([tmp_path / "pkg" / "module.so"], middle))
    slimming.remove_orphans(tmp_path)
    assert middle.exists() and not deep.exists()


def test_stripped_libraries_load_and_are_smaller(slimming, tmp_path):
    library = build(
        tmp_path / "lib.so", "static int hidden(int x) {return x + 1;} int f(int x) {return hidden(x);}"
    )
    before = library.stat().st_size
    slimming.strip(library)
    assert library.stat().st_size < before
    assert [path.name for path in tmp_path.iterdir()] == ["lib.so"]
    assert ctypes.CDLL(str(library)).f(41) == 42


def test_misaligned_segment_makes_a_library_unloadable(slimming, tmp_path):
    library = build(tmp_path / "lib.so", "int f(void) {return 1;}")
    assert slimming.loadable(library)
    data = bytearray(library.read_bytes())
    table = int.from_bytes(data[32:40], "little")
    first_load = next(k for k in range(20) if data[table + 56 * k] == 1)
    data[table + 56 * first_load + 8] ^= 8  # its offset in the file
    library.write_bytes(data)
    assert not slimming.loadable(library)


def test_library_shared_by_two_wheels_is_kept_once(slimming, tmp_path):
    code = "int f(void) {return 1;}"
    one = build(tmp_path / "a.libs" / "libgf-0123abcd.so.5", code)
    two = build(tmp_path / "b.libs" / "libgf-89abcdef-01234567.so.5", code)
    other = build(tmp_path / "b.libs" / "libgf-76543210.so.5", code + "int g(void) {return 2;}")
    slimming.link_twins(tmp_path)
    assert two.is_symlink() and two.resolve() == one
    assert not other.is_symlink()
    assert ctypes.CDLL(str(two)).f() == 1


def test_scipy_optimize_works_without_linear_programming():
    code = f"""
import importlib.util, sys
for name in ("_core", "_highs_options"):
    name = "scipy.optimize._highspy." + name
    spec = importlib.util.spec_from_file_location(name, {str(TOOLS / "left_out.py")!r})
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])
from scipy.optimize import linprog, nnls
print(nnls([[1.0, 0.0], [0.0, 2.0]], [3.0, 4.0])[0].tolist())
linprog([1.0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "[3.0, 2.0]\n", done.stderr
    assert done.returncode == 1  # and does not answer as if it had one
