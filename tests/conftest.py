"""What tests of all folders ask for by name; what they call stands in the modules beside."""

import os

import pytest
from problems import PROBLEMS, Problem


@pytest.fixture(params=PROBLEMS)
def problem(request: pytest.FixtureRequest) -> Problem:
    """Every system with known answers, one after the other."""
    return PROBLEMS[request.param]()


@pytest.fixture(scope="session", autouse=True)
def empty_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test depends on the code that this user's cache has, nor leaves any there."""
    os.environ["DRAKE_DAE_CACHE"] = str(tmp_path_factory.mktemp("cache") / "drake_dae")
