"""The poles of sampled laws, against maps by hand and runs."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, fixed_step, law
from numpy.testing import assert_allclose
from runs import run

from drake_dae import (
    ConstantReference,
    DaeSystem,
    RobotPlant,
    Sampling,
    TrackingLaw,
    make_closed_loop,
    poles,
)
from drake_dae.dae import sampled_poles
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ModelError

T = 0.05


def mass_on_a_spring(stiffness: float) -> DaeSystem:
    """x'' = -k x + u, z = x."""
    x, none = ca.SX.sym("x", 2), ca.SX(0, 1)
    f = ca.vertcat(x[1], -stiffness * x[0])
    return DaeSystem(x, f, ca.SX(2, 0), ca.SX([0, 1]), none, x[0], ca.SX(1, 0))


@pytest.mark.parametrize("delay", [0.0, 0.3 * T, T, 2.6 * T])
def test_poles_of_a_mass_are_those_of_the_map_by_hand(delay):
    """x'' = u: x_(k+1) is a polynomial of what is held, u = -w^2 x - 2 w x' of earlier samples."""
    w = 4.0
    late = int(delay / T + 1e-9)
    rest = delay - late * T
    gain = -np.array([w * w, 2.0 * w])
    matrix = np.zeros((2 * (late + 2), 2 * (late + 2)))
    matrix[2:, :-2] = np.eye(2 * (late + 1))
    matrix[:2, :2] = [[1.0, T], [0.0, 1.0]]
    newer = np.array([(T - rest) ** 2 / 2, T - rest])
    older = np.array([rest**2 / 2 + rest * (T - rest), rest])
    matrix[:2, 2 * late : 2 * late + 2] += np.outer(newer, gain)
    matrix[:2, 2 * late + 2 :] += np.outer(older, gain)
    found = sampled_poles(TrackingLaw(mass_on_a_spring(0.0), poles(-w)), np.zeros(3), T, delay)
    expected = np.linalg.eigvals(matrix)
    # A double pole moves by the root of round-off.
    assert_allclose(np.poly(found), np.poly(expected), atol=1e-12)


def pressing(sampling, duration, gains=-4.0, errors=0.0):
    """The two-link arm that holds still on its wall and presses, off its place at the start."""
    found = arm("two_link")
    chosen = law("two_link", poles(gains))
    references = [ConstantReference(0.3), ConstantReference(20.0)]
    plant = RobotPlant(found.model, structure=found.structure)
    loop = make_closed_loop(plant, chosen, references, LoopSettings(sampling=sampling))
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    q = found.model.configuration([0.3 + errors], plant.state(own)[:2])
    plant.set_consistent_state(own, np.concatenate([q, [0.0, 0.0]]))
    record = run(loop, context, duration, fixed_step(sampling.period / 20.0))
    return loop, record


@pytest.mark.parametrize(("period", "is_stable"), [(0.1, True), (0.25, False)])
def test_deviations_of_a_robot_follow_the_poles(period, is_stable):
    """With a delay of 0.3 periods 0.25 s is too long for poles at -4 1/s, and 0.1 s is not.

    All poles together give a recurrence between samples that holds for any linear course. The
    deviation begins with 1e-6 m, beside arms of a metre, and grows at most a hundredfold.
    """
    delay = 0.3 * period
    loop, record = pressing(Sampling(period, delay), 12.0 * period, errors=1e-6)
    rest = pressing(Sampling(period, delay), period)[1]["state"][0]
    found = sampled_poles(loop.controller.law, record["reference"][0], period, delay, state=rest)
    assert (np.abs(found).max() < 1.0) == is_stable
    samples = np.searchsorted(record.time, period * np.arange(12) - 1e-9)
    error = record["tracking_error"][samples, 0]
    factors = np.poly(found).real
    count = factors.size
    left = [factors @ error[k + 1 - count : k + 1][::-1] for k in range(count, 12)]
    assert_allclose(left, 0.0, atol=1e-4 * np.abs(error).max())
    assert (np.abs(error[-1]) < 1e-6) == is_stable


def test_laws_with_a_state_of_their_own_are_refused():
    system = mass_on_a_spring(0.0)
    chosen = TrackingLaw(system, poles(-4.0), integral=[system.output_signals[0].name])
    with pytest.raises(ModelError, match="integral"):
        sampled_poles(chosen, np.zeros(3), T)
    with pytest.raises(ModelError, match="delay"):
        sampled_poles(TrackingLaw(system, poles(-4.0)), np.zeros(3), T, -1.0)
