"""Sampled laws: their poles and their errors to first order, against maps by hand and runs."""

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
    SinusoidReference,
    TrackingLaw,
    make_closed_loop,
    poles,
)
from drake_dae.dae import sampled_poles, sampling_error
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


@pytest.mark.slow
def test_error_of_a_sampled_run_is_reported_beforehand():
    """To second order: a period of 4 ms leaves a quarter of what 8 ms leave off the prediction."""
    found, chosen = arm("two_link"), law("two_link", poles(-10.0))
    references = [SinusoidReference(0.3, 0.1, 2.0), SinusoidReference(20.0, 5.0, 3.0)]

    def record_of(sampling, step):
        plant = RobotPlant(found.model, structure=found.structure)
        loop = make_closed_loop(plant, chosen, references, LoopSettings(sampling=sampling))
        return run(loop, loop.diagram.CreateDefaultContext(), 0.6, fixed_step(step))

    ideal = record_of(None, 4e-3)
    off = []
    for period in (8e-3, 4e-3):
        sampling = Sampling(period, 0.5 * period)
        # Steps end where controls change.
        late = record_of(sampling, 0.5 * period)
        told = sampling_error(
            chosen, ideal.time, ideal["state"], ideal["control"], period, sampling.delay
        )
        times = period * np.arange(int(0.2 / period), int(0.6 / period))
        # A new control acts half a period after each sample.
        times = times + np.array([[0.0], [0.5 * period]])
        error = np.column_stack(
            [
                np.interp(times[0], late.time, late["tracking_error"][:, 0]),
                np.interp(times[1], late.time, late["tracking_error"][:, 1]),
            ]
        )
        before = np.column_stack(
            [
                np.interp(times[0], ideal.time, (ideal["tracking_error"] + told)[:, 0]),
                np.interp(times[1], ideal.time, (ideal["tracking_error"] + told)[:, 1]),
            ]
        )
        off.append(np.abs(error - before).max(axis=0))
        assert np.all(off[-1] < 0.05 * np.abs(told).max(axis=0))
    assert_allclose(off[0] / off[1], 4.0, rtol=0.25)


def test_laws_with_a_state_of_their_own_are_refused():
    system = mass_on_a_spring(0.0)
    chosen = TrackingLaw(system, poles(-4.0), integral=[system.output_signals[0].name])
    with pytest.raises(ModelError, match="integral"):
        sampled_poles(chosen, np.zeros(3), T)
    with pytest.raises(ModelError, match="delay"):
        sampled_poles(TrackingLaw(system, poles(-4.0)), np.zeros(3), T, -1.0)
    plain = TrackingLaw(system, poles(-4.0))
    for sizes in ((2, 1), (3, 2)):
        rows = np.zeros((sizes[0], 2)), np.zeros((3, sizes[1]))
        with pytest.raises(ModelError, match=r"\(3, .\)"):
            sampling_error(plain, [0, 1, 2], *rows, T)
