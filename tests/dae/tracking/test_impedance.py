"""Gains from the stiffness of outputs against forces, beside MultibodyPlant and SciPy."""

import numpy as np
import pytest
from arms import arm, numbers
from numpy.testing import assert_allclose
from runs import scenario
from scipy.linalg import sqrtm

from drake_dae import TrackingLaw, find_structure, impedance_gains, open_contact, poles
from drake_dae.errors import GainError, ScenarioError
from drake_dae.scenario.build import build_completed

STIFFNESS = {"tool.y": 150.0, "tool.z": 80.0, "tool.z_axis.y": 3.0}
CHOSEN, DAMPING_RATIO = [0, 1, 2], 0.7


def structures():
    closed = arm("seven_joint").structure
    return {"closed": closed, "open": find_structure(open_contact(closed.system, "wall.force"))}


@pytest.mark.parametrize("contact", ["open", "closed"])
def test_gains_are_the_stiffness_over_the_apparent_inertia(contact):
    """With M, J and P of MultibodyPlant, to round-off times the condition of W of some 1e3."""
    structure = structures()[contact]
    gains = TrackingLaw(
        structure.system,
        impedance_gains(structure, STIFFNESS, DAMPING_RATIO, poles(-9.0)),
        structure=structure,
    ).gains
    q, v = np.split(structure.states[0], 2)
    found = numbers("seven_joint", q, v)
    P, J = found.output_jacobian[CHOSEN], found.constraint_jacobian
    mobility = np.linalg.inv(found.mass)
    if contact == "closed":
        mobility -= mobility @ J.T @ np.linalg.inv(J @ mobility @ J.T) @ J @ mobility
    inertia = np.linalg.inv(P @ mobility @ P.T)
    starts = gains.layout.starts[CHOSEN]
    stiffness, damping = (inertia @ gains.matrix[np.ix_(CHOSEN, starts + i)] for i in (0, 1))
    assert_allclose(stiffness, np.diag([*STIFFNESS.values()]), atol=1e-9 * 150)
    assert_allclose(damping, damping.T, rtol=1e-9, atol=1e-9)
    expected = 2.0 * DAMPING_RATIO * inertia @ sqrtm(np.linalg.inv(inertia) @ stiffness).real
    assert_allclose(damping, expected, rtol=1e-8, atol=1e-8)
    others = np.setdiff1d(np.arange(7), CHOSEN)
    dynamic = [i for i in others if gains.degrees[i]]
    rest = gains.matrix[np.ix_(dynamic, gains.layout.starts[dynamic])]
    assert_allclose(rest, 81.0 * np.eye(len(dynamic)), rtol=1e-12)
    modes = gains.poles[np.abs(gains.poles + 9.0) > 1e-3]
    assert_allclose(-modes.real / np.abs(modes), DAMPING_RATIO, rtol=1e-6)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"stiffness": {}}, ["stiffness", "at least one output"]),
        ({"stiffness": {"tool.x": 1.0}}, ["no output 'tool.x'", "tool.y"]),
        ({"stiffness": {"wall.force": 1.0}}, ["'wall.force' has degree 0"]),
        ({"stiffness": {"tool.y": 0.0}}, ["stiffness of tool.y must be positive, got 0"]),
        ({"damping_ratio": -1.0}, ["damping_ratio must be positive, got -1"]),
        ({"rest": None}, ["tool.z_axis.z, joint3, joint7", "poles"]),
    ],
)
def test_what_makes_no_sense_is_refused(settings, words):
    structure = structures()["closed"]
    given = {"stiffness": STIFFNESS, "rest": poles(-9.0)} | settings
    with pytest.raises(GainError) as refused:
        TrackingLaw(structure.system, impedance_gains(structure, **given), structure=structure)
    assert all(part in str(refused.value) for part in words), refused.value


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        (
            "two_link_wall",
            ["gains=!Impedance {stiffness: {tool.z: 9}}", "integral=[tool.z]"],
            "gains or integral: stiffness: the error of 'tool.z' is integrated",
        ),
    ],
)
def test_a_scenario_refuses_it_where_no_force_would_be_felt(name, settings, words):
    with pytest.raises(ScenarioError) as refused:
        build_completed(scenario(name, *settings))
    assert words in str(refused.value)
