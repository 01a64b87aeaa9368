"""The command line as such: help, names, speed, what is imported, one line for whatever is wrong."""

import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from share import __version__
from share.cli.main import COMMANDS, main

SHARE = [sys.executable, "-m", "share"]
HEAVY = [
    "cv2",
    "scipy",
    "gtsam",
    "onnxruntime",
    "matplotlib",
    "zmq",
    "rosbags",
    "mcap",
    "poselib",
    "numpy",
    "yaml",
    "msgspec",
    "filterpy",
]
HELPS = [
    [],
    *([name] for name in COMMANDS),
    *(["dataset", name] for name in ("info", "convert", "recover")),
]


def run(capsys, *arguments):
    """Exit code, stdout, stderr of `share ARGUMENTS`, within this process."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return end.value.code, out, err


@pytest.mark.parametrize("command", HELPS, ids=" ".join)
def test_help(command, capsys):
    code, out, err = run(capsys, *command, "--help")
    assert (code, err) == (0, "")
    assert out.startswith(" ".join(["Usage: share", *command, "["]))
    assert ("Example:  share " if command else "Try it:   share demo") in out
    assert "..." not in out.replace("[ARGS]...", "")  # no help text is cut off
    assert run(capsys, *command, "-h") == (0, out, "")


def test_help_imports_nothing_heavy():
    program = (
        "import sys\nfrom share.cli.main import main\n"
        f"for command in {HELPS}:\n"
        "    try: main([*command, '--help'])\n"
        "    except SystemExit as end: assert end.code == 0\n"
        f"print('loaded:', *set({HEAVY}) & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "loaded:", done.stderr


def test_help_is_quick():
    """CPU time of the whole process, best of three: this machine may be busy."""
    spent = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*SHARE, "--help"], check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(spent) < 0.5


def test_dataset_names_its_commands(capsys):
    code, out, _ = run(capsys, "dataset", "--help")
    assert code == 0
    assert all(f"  {name} " in out for name in ("info", "convert", "recover"))


def test_module_and_script_are_one_program():
    done = subprocess.run([*SHARE, "track"], capture_output=True, text=True, timeout=30)
    assert done.returncode == 2
    assert done.stderr == "share: Missing argument 'SOURCE'. (see `share track --help`)\n"
    script = Path(sys.executable).with_name("share")
    if script.exists():
        again = subprocess.run([script, "track"], capture_output=True, text=True, timeout=30)
        assert (again.returncode, again.stderr) == (done.returncode, done.stderr)


def test_version(capsys):
    assert run(capsys, "--version") == (0, f"share, version {__version__}\n", "")


def test_no_arguments_is_the_help_and_wrong_use(capsys):
    code, out, err = run(capsys)
    assert (code, out) == (2, "")
    assert err.startswith("Usage: share ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("trak", "no command 'trak'; did you mean 'track'?"),
        ("Edge", "no command 'Edge'; did you mean 'edge'?"),
        ("xyz", "no command 'xyz'; there are demo, track, agent, edge, dataset"),
        ("--bogus", "No such option '--bogus'"),
        ("dataset inf", "No such command 'inf'. Did you mean 'info'?"),
        ("track", "Missing argument 'SOURCE'"),
        ("track x y", "unexpected extra argument (y)"),
        ("track x --ot y", "No such option '--ot'. (Did you mean one of: '--json', '--out'"),
        ("track x --out", "Option '--out' requires an argument"),
        ("track x --frames 3", "'3' is not a range of frames such as 0:250"),
        ("track x --frames 5:5", "'5:5' is not a range of frames"),
        ("track x --frames=-5:", "'-5:' is not a range of frames"),
        ("agent x --kind ar --edge tcp://localhost:1", "Missing option '--name'"),
        ("agent x --name a --edge tcp://localhost:1", "Missing option '--kind'"),
        ("agent x --name a --kind ar", "Missing option '--edge'"),
        ("agent x --name a --kind car --edge tcp://localhost:1", "'car' is not one of 'ar', 'robot'"),
        ("edge --policy best", "'best' is not"),
        ("edge extra", "unexpected extra argument (extra)"),
        ("demo --seconds 1", "1.0 is not in the range 3<=x<=600"),
        ("demo --seconds 601", "601.0 is not in the range"),
        ("demo --seconds soon", "'soon' is not a valid float"),
        ("demo --seconds nan", "nan"),
        ("demo --seed -1", "-1 is not in the range x>=0"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(arguments, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *arguments.split())
    assert (code, out) == (2, "")
    assert err.startswith("share: ")
    assert err.count("\n") == 1
    assert said in err
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_goes_away_is_no_traceback():
    """`share --help | head -1`, with a reader that is gone before we write."""
    with subprocess.Popen([*SHARE, "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_output_to_a_full_disk_is_one_line():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*SHARE, "--help"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (1, "share: cannot write the output: No space left on device\n")


@pytest.mark.parametrize(
    ("number", "code", "said"), [(signal.SIGINT, 130, "share: interrupted\n"), (signal.SIGTERM, 143, "")]
)
def test_an_interrupted_command_leaves_nothing_behind(number, code, said, tmp_path):
    """The demo is stopped while it makes its session: no files, and no process that goes on making them."""
    process = subprocess.Popen(
        [*SHARE, "demo", "--seconds", "600", "--out", str(tmp_path / "out")],
        env={"XDG_CACHE_HOME": str(tmp_path / "cache")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    cache = tmp_path / "cache" / "share"
    deadline = time.monotonic() + 20
    while not list(cache.glob(".room*/*.mcap.part")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    assert process.communicate(timeout=20) == ("", said)  # at its end: nobody has the pipes open still
    assert process.returncode == code
    assert list(cache.iterdir()) == []
