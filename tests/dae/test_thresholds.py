"""What counts as singular can be seen and set."""

import pytest

from drake_dae import analyze
from drake_dae.analysis import Finding
from drake_dae.dae import DaeSystem, find_structure
from drake_dae.errors import AssumptionError


def nearly_singular(off, **more):
    """z' = [[1, 1], [1, 1 + off]] u: the smallest singular value is off / 8^0.5, rows scaled."""
    return DaeSystem.from_functions(
        2,
        f=lambda x: [-x[0], -x[1]],
        h=lambda x: [[1, 1], [1, 1 + off]],
        l=lambda x: [x[0], x[1]],
        **more,
    )


@pytest.mark.parametrize("off", [1e-7, 1e-10])
def test_how_near_to_singular_is_singular_is_said_and_can_be_set(off):
    with pytest.raises(AssumptionError, match=r"least_margin.*1e-06"):
        find_structure(nearly_singular(off))
    report = analyze(nearly_singular(off))
    assert report.assumptions[4].finding is Finding.VIOLATED
    allowed = nearly_singular(off, least_margin=0.1 * off)
    assert find_structure(allowed).control_margin.relative == pytest.approx(off / 8**0.5, rel=0.01)
    assert analyze(allowed).assumptions[4].finding is Finding.SATISFIED
    assert f"{0.1 * off:.0e}" in str(analyze(allowed))
    with pytest.raises(AssumptionError, match="least_margin"):
        find_structure(nearly_singular(0.1, least_margin=0.3))
