"""What is said before a run about the laws for springs in the joints."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import scenario

from drake_dae.scenario.feasibility.feasibility import find_feasibility

SPRINGS = "actuation=[!FlexibleJoints {{stiffness: {}, inertia: 1.0}}]"
LATE = "sampling={period: 1.0e-3, delay: 1.0e-3}"


def found(*settings: str, stiffness: float = 8000.0):
    return find_feasibility(
        scenario("two_link_wall", "duration=1", SPRINGS.format(stiffness), LATE, *settings)
    )


@pytest.mark.slow
def test_the_swing_is_that_of_links_against_shafts():
    """W^2 = K (1 / M + 1 / B), with M of the links at the nominal state, near the start."""
    report = found("law=!SpringCascade {}")
    laws, links = report.laws, report.analysis.system
    (mass,) = links.trace("M", {"M": links.mass_matrix[2:, 2:]}, often=False)(
        links.nominal_state, links.parameter_values
    )
    lightest = np.linalg.eigvalsh(mass.reshape(2, 2)).min()
    assert_allclose(laws.swing, np.sqrt(8000.0 * (1.0 / lightest + 1.0)), rtol=0.1)
    assert_allclose(laws.late, 1.5e-3)
    assert_allclose(laws.pole, laws.swing**2 * laws.late / 20.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "stiffness", "tracking", "cascade"),
    [
        (("law=!SpringCascade {}",), 8000.0, True, True),
        (("law=!Tracking {}", "encoders={velocity_noise: 0.1}"), 8000.0, False, False),
        (("law=!SpringCascade {}", "sampling={period: 0.02, delay: 0.02}"), 8e5, False, False),
    ],
)
def test_noise_and_samples_decide(settings, stiffness, tracking, cascade):
    """Neither law bears noise of 0.1 rad/s, nor springs that swing several times in a sample."""
    report = found(*settings, stiffness=stiffness)
    laws = report.laws
    assert (laws.bears_tracking, laws.bears_cascade) == (tracking, cascade)
    assert laws.lines[1].startswith("!Tracking")
    assert laws.lines[2].startswith("!SpringCascade")
    word = {(True, True): "both laws", (False, False): "neither law"}[tracking, cascade]
    assert word in laws.lines[3]
    assert report.to_dict()["spring_laws"]["bears_cascade"] is cascade


def test_nothing_is_said_without_springs():
    assert find_feasibility(scenario("two_link_wall", "duration=1", LATE)).laws is None
