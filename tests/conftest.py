"""What tests of all folders ask for by name; what they call stands in the modules beside."""

import gc
import os
import signal
from collections.abc import Iterator

import pytest

# Before NumPy is loaded: matrices here are small, and threads only wait for each other. What the
# tests start inherits it.
for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[threads] = "1"

from problems import PROBLEMS, Problem  # noqa: E402


@pytest.fixture(params=PROBLEMS)
def problem(request: pytest.FixtureRequest) -> Problem:
    """Every system with known answers, one after the other."""
    return PROBLEMS[request.param]()


@pytest.fixture(scope="session", autouse=True)
def same_surroundings(tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test depends on who runs it, in which window, nor on the code that this user's cache has.

    What these processes start inherits the same.
    """
    os.environ["DRAKE_DAE_CACHE"] = str(tmp_path_factory.mktemp("cache") / "drake_dae")
    # How wide a terminal is and whether it has colours, and what a user sets for all of Python.
    for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "PYTHON_COLORS"):
        os.environ.pop(name, None)
    for name in ("PYTHONIOENCODING", "PYTHONOPTIMIZE", "PYTHONWARNINGS", "MPLBACKEND"):
        os.environ.pop(name, None)
    os.umask(0o022)
    # Garbage is collected between tests, in the main thread: pytest-xdist has a second one in each
    # process, and what it frees would break expressions that a test is building.
    gc.disable()


def pytest_runtest_teardown() -> None:
    if gc.get_count()[0] > 100_000:
        gc.collect()


@pytest.fixture
def signals_of_a_shell() -> Iterator[None]:
    """Signals as a command in a terminal has them.

    A process under nohup ignores SIGHUP, one in the background of a script ignores SIGINT, and what
    they start inherits that.
    """
    handlers = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler or signal.SIG_DFL)
