"""The table of `examples/unknown_friction`, of which a short piece is run here."""

import pytest
from programs import loaded


@pytest.fixture(scope="module")
def example():
    with loaded("unknown_friction") as module:
        yield module


@pytest.mark.slow
def test_row_with_noise_and_a_load_has_figures(example):
    """In 0.3 s the contact has begun: not the accuracy of the table, which `make` prints."""
    row = example.figures(example.Condition("both", settings=example.FAINT, load=0.5), 0.3)
    assert 0.0 < row.position < 50.0
    assert 0.0 < row.force < 10.0
    assert 0.1 < row.roughness < 1.0
    assert 0.0 < row.friction < 1.0
