"""The plants of `examples/bounded_arms`, of which a few are run here."""

import pytest
from programs import loaded


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Of the vendor's file.
def test_a_few_plants_keep_the_bound_that_is_printed_before(tmp_path, capsys):
    with loaded("bounded_arms") as module:
        module.main(["ur5-soft", "--runs", "4", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    bound, held = map(printed.index, ("bound: the worst of 170 runs", "4 of 4 within their bound"))
    assert bound < held
