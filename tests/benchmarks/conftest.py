import pytest


@pytest.fixture
def report(capsys):
    """Prints a line past pytest's capture."""

    def write(line):
        with capsys.disabled():
            print(f"\n{line}", end="")

    return write
