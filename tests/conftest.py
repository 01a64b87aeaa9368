"""What all tests share."""

from share import startup

startup.prepare_process()

import gc  # noqa: E402
import hashlib  # noqa: E402
import itertools  # noqa: E402
import shutil  # noqa: E402
import signal  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Generator, Iterator  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from helpers.shell import Done  # noqa: E402

from share.cli.main import main  # noqa: E402

# Where tests run in the background of a shell, Ctrl-C is ignored, by all that they start too; so is SIGHUP
# with nohup.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """All that is made meanwhile stays: looking through it for garbage takes a fifth of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


ROOT = Path(__file__).resolve().parents[1]
_tests = itertools.count()


@pytest.fixture(autouse=True)
def no_memory(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test knows what another has learnt of a camera, nor tells it to whoever runs them."""
    state = tmp_path_factory.getbasetemp() / f"state-{next(_tests)}"  # is made by who writes there
    monkeypatch.setenv("XDG_STATE_HOME", str(state))


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded, the same in every run."""
    return np.random.default_rng(20261121)


@pytest.fixture
def share(capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """`share ARGUMENTS` within this process."""

    def run(*arguments: object) -> Done:
        with pytest.raises(SystemExit) as end:
            main([str(argument) for argument in arguments])
        assert isinstance(end.value.code, int)
        return Done(end.value.code, *capsys.readouterr())

    return run


@pytest.fixture
def soon() -> Iterator[None]:
    """The test takes little CPU time: most that use this take milliseconds, what goes wrong takes minutes."""
    began = time.process_time()
    yield
    assert time.process_time() - began < 20.0


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings beside the checkout; they are not part of it."""
    path = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not path.is_dir():
        pytest.skip(f"real recordings are not here: {path} does not exist")
    return path


def sources_digest() -> str:
    """Of all that an emulated session is made by."""
    digest = hashlib.sha256()
    for path in sorted([*(ROOT / "share").rglob("*.py"), *(ROOT / "firmware_profiles").glob("*.yaml")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@pytest.fixture(scope="session")
def plain_cache(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's cache folder ($XDG_CACHE_HOME) with the three seconds that `share demo --scene plain
    --seconds 3 --seed 18` plays: ar1, ar2 and robot in the plain room, 45 frames each. With this seed
    each device has had 20 IMU samples by its first picture, all that the tracker needs to begin.

    Made once for these sources: pytest keeps it in .pytest_cache, for all its workers and runs."""
    from share.lab.emulate.recipe import demo_recipe
    from share.lab.emulate.session import make_cached_session

    kept = getattr(request.config, "cache", None)  # none with -p no:cacheprovider
    folder = tmp_path_factory.mktemp("cache") if kept is None else kept.mkdir("plain-session")
    cache = Path(folder) / sources_digest()
    for old in sorted(Path(folder).iterdir(), key=lambda one: one.stat().st_mtime)[:-2]:
        shutil.rmtree(old, ignore_errors=True)
    make_cached_session(demo_recipe("plain", 3.0, 18), cache / "share")
    return cache


@pytest.fixture(scope="session")
def plain_session(plain_cache: Path) -> Path:
    """The session in there."""
    (session,) = (plain_cache / "share").glob("session-*")
    return session
