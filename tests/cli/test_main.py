"""The command line itself: help, names, speed, imports, one line for each error."""

import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from share import __version__
from share.cli.commands import COMMANDS
from share.cli.main import main
from share.config import POLICY_NAMES

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
    *(name.split() for name in COMMANDS),
    *(["dataset", name] for name in ("info", "convert", "recover")),
    *(["sync", name] for name in ("server", "check")),
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
    example = out.partition("Example:  " if command else "Try it:   ")[2]
    assert f"share {' '.join(command) or 'demo'}" in example
    assert "..." not in out.partition("\n\n")[2]  # after the usage: no help text is cut off
    assert run(capsys, *command, "-h") == (0, out, "")


@pytest.mark.parametrize("command", ["edge", "demo", "evaluate run", "evaluate sweep", "evaluate ablation"])
def test_help_explains_each_policy(command, capsys):
    _, out, _ = run(capsys, *command.split(), "--help")
    rows = out.partition("Policies:")[2].partition("Example:")[0].split("\n\n")[0].splitlines()[1:]
    assert [row.split()[0] for row in rows] == list(POLICY_NAMES)
    assert all(len(row.split()) > 4 for row in rows)


def test_edge_says_that_policy_overrides_that_of_its_settings(tmp_path, capsys):
    config = tmp_path / "c.yaml"
    config.write_text("edge: {policy: linear}")
    _, _, err = run(capsys, "edge", "--config", config, "--policy", "streamed", "--map", tmp_path / "m")
    first, second = err.splitlines()
    assert first == f"share: {config}: edge.policy linear is overridden by policy streamed"
    assert "--map: policy streamed builds no map" in second


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


def test_dataset_help_lists_its_commands(capsys):
    code, out, _ = run(capsys, "dataset", "--help")
    assert code == 0
    assert all(f"  {name} " in out for name in ("info", "convert", "recover"))


def test_module_and_script_are_the_same_program():
    done = subprocess.run([*SHARE, "track"], capture_output=True, text=True, timeout=30)
    assert done.returncode == 2
    assert done.stderr == "share: Missing argument 'SOURCE'. (see `share track --help`)\n"
    script = Path(sys.executable).with_name("share")
    if script.exists():
        again = subprocess.run([script, "track"], capture_output=True, text=True, timeout=30)
        assert (again.returncode, again.stderr) == (done.returncode, done.stderr)


def test_version(capsys):
    assert run(capsys, "--version") == (0, f"share, version {__version__}\n", "")


def test_no_arguments_prints_help_with_exit_code_2(capsys):
    code, out, err = run(capsys)
    assert (code, out) == (2, "")
    assert err.startswith("Usage: share ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("trak", "no command 'trak'; did you mean 'track'?"),
        ("Edge", "no command 'Edge'; did you mean 'edge'?"),
        ("xyz", "no command 'xyz'; commands: demo, capture, track, agent, edge, site, watch, dataset"),
        ("--bogus", "No such option '--bogus'"),
        ("dataset inf", "no command 'inf'; did you mean 'info'?"),
        ("evaluate ate", "no command 'ate'; commands: run, score, ablation, sweep, paper, compare"),
        ("track", "Missing argument 'SOURCE'"),
        ("track x y", "unexpected extra argument (y)"),
        ("track x --ot y", "No such option '--ot'. (Did you mean one of: '--mode', '--out'"),
        ("track x --out", "Option '--out' requires an argument"),
        ("track x --frames 3", "'3' is not a range of frames such as 0:250"),
        ("track x --frames 5:5", "'5:5' is not a range of frames"),
        ("track x --frames=-5:", "'-5:' is not a range of frames"),
        ("agent x --kind ar --edge tcp://localhost:1", "Missing option '--name'"),
        ("agent x --name a --edge tcp://localhost:1", "--kind is required: ar (headset) or robot"),
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


def test_closed_pipe_gives_no_traceback():
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


# ------------------------------------------------------------------ interrupted while it makes a session


def interrupted(home: Path, number: int) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a demo that gets a signal while it draws its session."""
    with subprocess.Popen(
        [*SHARE, "demo", "--scene", "plain", "--seed", "0", "--seconds", "3", "--out", str(home / "out")],
        env={"XDG_CACHE_HOME": str(home)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        deadline = time.monotonic() + 60
        while not chunks(home) and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(number)
        out, err = process.communicate(timeout=20)  # at its end: nobody has the pipes open still
    return process.returncode, out, err


def chunks(home: Path) -> dict[Path, int]:
    """Return the files of an incomplete session and their times."""
    return {path: path.stat().st_mtime_ns for path in home.glob("share/.session-*/**/*.chunk")}


def only_unfinished(home: Path) -> bool:
    """Nothing in the cache looks like a session, or like a recording of one."""
    (left,) = (home / "share").iterdir()
    return left.name.startswith(".session-") and not [*left.rglob("session.yaml"), *left.rglob("*.mcap*")]


@pytest.mark.long
def test_ended_command_leaves_no_complete_looking_output(tmp_path):
    assert interrupted(tmp_path, signal.SIGTERM) == (143, "", "")
    assert chunks(tmp_path)
    assert only_unfinished(tmp_path)


@pytest.mark.slow
def test_interrupted_command_continues_when_run_again(tmp_path):
    from share.lab.emulate.recipe import demo_recipe
    from share.lab.emulate.session import make_cached_session

    assert interrupted(tmp_path, signal.SIGINT) == (130, "", "share: interrupted\n")
    left, seen = chunks(tmp_path), []
    assert left
    assert only_unfinished(tmp_path)

    def watch(what: str, done: int, total: int) -> None:
        seen.append((what, done))
        now = chunks(tmp_path)
        assert {path: now[path] for path in left} == left  # not drawn again

    session = make_cached_session(demo_recipe("plain", 3.0, 0), tmp_path / "share", progress=watch)
    began = next(done for what, done in seen if what == "drawing images")
    assert 0 < began < 135  # frames that were there at once
    assert ("drawing images", 135) in seen
    assert list((tmp_path / "share").iterdir()) == [session]  # whole, and nothing else is left
    assert sorted(path.name for path in session.glob("*.mcap")) == ["ar1.mcap", "ar2.mcap", "robot.mcap"]
