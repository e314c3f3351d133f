"""What tests of all folders ask for by name; what they call stands in the modules beside."""

import pytest
from problems import PROBLEMS, Problem


@pytest.fixture(params=PROBLEMS)
def problem(request: pytest.FixtureRequest) -> Problem:
    """Every system with known answers, one after the other."""
    return PROBLEMS[request.param]()
