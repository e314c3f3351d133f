"""The table of `examples/unknown_friction`, of which a short piece is run here."""

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "unknown_friction"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("unknown_friction", FOLDER / "__main__.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.slow
def test_row_with_noise_and_a_load_has_figures(example):
    """In 0.3 s the contact has begun: not the accuracy of the table, which `make` prints."""
    row = example.figures(example.Condition("both", noise=True, load=0.5), 0.3)
    assert 0.0 < row.position < 50.0
    assert 0.0 < row.force < 10.0
    assert 0.1 < row.roughness < 1.0
    assert 0.0 < row.friction < 1.0
