"""Integral action of the law, against the prediction and closed forms."""

import numpy as np
import pytest
from arms import arm, error_controlled, numbers, touching
from numpy.testing import assert_allclose

import drake_dae as dd
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import GainError, ModelError
from drake_dae.robots import KnownForce

WANTED = [dd.SinusoidReference(0.3, 0.2, 1.5), dd.SinusoidReference(20.0, 5.0, 2.0)]


def follow(model, tracking, duration, *, start=None, change=None, wanted=WANTED, sensor=None):
    """The closed loop and its record, from rest with errors, or with other plant parameters."""
    plant = dd.RobotPlant(model, structure=tracking.structure)
    loop = dd.make_closed_loop(plant, tracking, wanted, LoopSettings(sensor=sensor))
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    q = model.configuration([0.28], [1.2, -1.6])
    plant.set_consistent_state(own, model.rest_state(q, [18.0]))
    for name, value in (change or {}).items():
        plant.set_parameter(own, name, value)
    if start is not None:
        controller = loop.controller.GetMyMutableContextFromRoot(context)
        controller.SetContinuousState(start)
    dd.simulate(loop.diagram, context, duration, error_controlled(1e-9))
    return loop, loop.record(context)


def test_errors_are_those_of_one_more_pole():
    """s^3 + ... = (s + 4)^3 for the position, s + 6 for the force from a chosen start.

    e_2(0) = -6 sigma(0), and the integrals are those of the recorded errors.
    """
    model, structure = arm("two_link").model, arm("two_link").structure
    tracking = dd.TrackingLaw(
        model.dae,
        dd.poles({"tool.z": -4.0, "wall.force": -6.0}),
        structure=structure,
        measured_force=True,
        integral=["tool.z", "wall.force"],
    )
    assert tracking.gains.degrees == (3, 1)
    loop, record = follow(model, tracking, 2.0, start=[0.01, 0.5])
    predicted = loop.predicted_error(record)
    assert predicted[0] == pytest.approx([-0.02, -3.0])
    assert predicted[:, 1] == pytest.approx(-3.0 * np.exp(-6.0 * record.time), abs=1e-12)
    assert_allclose(record["tracking_error"][:, 0], predicted[:, 0], atol=1e-9)
    assert_allclose(record["tracking_error"][:, 1], predicted[:, 1], atol=1e-7)
    steps = np.diff(record.time)[:, None]
    means = (record["tracking_error"][1:] + record["tracking_error"][:-1]) / 2.0
    summed = np.array([0.01, 0.5]) + np.cumsum(steps * means, axis=0)
    assert_allclose(record["integral"][1:], summed, atol=2e-3)


def test_a_push_that_the_law_does_not_know_is_integrated_away():
    """At rest A_h F / w^2 off without, with A_h by MultibodyPlant; nothing with it."""
    push = KnownForce("tool", name="push")
    smooth = touching("two_link")
    model = dd.RobotModel(
        smooth.links, smooth.constraints, smooth.outputs, [1.2, -1.6], known_forces=[push]
    )
    structure = dd.find_structure(model.dae)
    wanted, ends = [dd.ConstantReference(0.3), dd.ConstantReference(20.0)], {}
    for names in ([], ["tool.z"]):
        tracking = dd.TrackingLaw(model.dae, dd.poles(-8.0), structure=structure, integral=names)
        _, record = follow(
            model, tracking, 4.0, change={"push.force": [0.0, 0.0, 6.0]}, wanted=wanted
        )
        ends[bool(names)] = record["tracking_error"][-1, 0], record["state"][-1]
    n = numbers("two_link", *np.split(ends[False][1], 2))
    J, P = n.constraint_jacobian, n.output_jacobian
    free = np.linalg.solve(n.mass, np.eye(2))
    along = P @ (free - free @ J.T @ np.linalg.solve(J @ free @ J.T, J @ free)) @ P.T
    # The law holds z'' as if the force were the model's: F moves it through M^-1, less what the
    # wall takes of it.
    assert ends[False][0] == pytest.approx(along.item() * 6.0 / 64.0, rel=1e-5)
    assert abs(ends[True][0]) < 1e-6 < 1e-3 < abs(ends[False][0])


def test_what_makes_no_sense_is_refused():
    found = arm("two_link")
    system, known = found.model.dae, {"structure": found.structure}
    with pytest.raises(GainError, match=r"wall\.force"):
        dd.TrackingLaw(system, dd.poles(-4.0), integral=["wall.force"], **known)
    with pytest.raises(GainError, match=r"'tool\.z'"):
        dd.TrackingLaw(system, dd.poles(-4.0), integral=["tool.z", "tool.z"], **known)
    with pytest.raises(ModelError, match=r"integral: .*tool\.y"):
        dd.TrackingLaw(system, dd.poles(-4.0), integral=["tool.y"], **known)
