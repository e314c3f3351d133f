"""Contacts with friction that open and close: Painleve's rod."""

import numpy as np
import pytest
from arms import error_controlled
from falling import simulator_of
from numpy.testing import assert_allclose
from painleve import GRAVITY, HALF, MASS, SPEED, rod, sliding
from pydrake.systems.framework import DiagramBuilder

from drake_dae import (
    ConstantReference,
    ReferenceGenerator,
    SinusoidReference,
    TrackingController,
    TrackingLaw,
    UnilateralRobotPlant,
    poles,
    rollout,
    simulate,
    start_values,
)
from drake_dae.dae.system.contacts import PainleveOutcome
from drake_dae.errors import PainleveError


@pytest.fixture(scope="module")
def plant():
    return UnilateralRobotPlant(rod(1.5, 1.1), {"floor": 0.0})


@pytest.mark.parametrize(
    ("turn", "outcome"), [(0.0, PainleveOutcome.INCONSISTENT), (6.0, PainleveOutcome.INDETERMINATE)]
)
def test_in_the_paradox_a_rod_does_not_start(plant, turn, outcome):
    """b = l sin a a'^2 - g: a rod at rest would pierce the floor, one that turns fast lifts off."""
    with pytest.raises(PainleveError, match=f"'?floor'? .*{outcome.name.lower()}:") as caught:
        simulator_of(plant, sliding(1.1, turn))
    assert caught.value.outcome is outcome


def test_a_run_into_the_edge_stops_there():
    """A law that knows the friction keeps lambda at 5 N, so b = -A lambda: beyond, two fit.

    tan a = (9 + 17^(1/2)) / 4 where 3 mu t = t^2 + 4 with mu = 1.5; a(t) is as commanded.
    """
    model = rod(1.5, np.deg2rad(80.0))
    law = TrackingLaw(model.dae, poles(-6.0))
    path = SinusoidReference(np.deg2rad(60.0), np.deg2rad(20.0), np.pi / 4.0, np.pi / 2.0)
    slide = SinusoidReference(0.0, -2.0 / 1e-2, 1e-2)
    builder = DiagramBuilder()
    plant = builder.AddSystem(UnilateralRobotPlant(model, {"floor": 0.0}))
    reference = builder.AddSystem(
        ReferenceGenerator([slide, path, ConstantReference(5.0)], law.degrees)
    )
    controller = builder.AddSystem(TrackingController(law))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), plant.GetInputPort("control"))
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    plant.set_state(context, law.structure.manifold.project(sliding(np.deg2rad(80.0))))
    given = *start_values(diagram, root), np.linspace(0.0, 3.5, 8)
    (rolled,) = rollout(diagram, *given, config=error_controlled(1e-8))
    with pytest.raises(PainleveError, match="floor") as caught:
        simulate(diagram, root, 3.5, error_controlled(1e-8))
    angle = np.arctan((9.0 + np.sqrt(17.0)) / 4.0)
    when = np.arccos((np.rad2deg(angle) - 60.0) / 20.0) / (np.pi / 4.0)
    for error in (caught.value, rolled.failure):
        assert isinstance(error, PainleveError)
        assert error.time == pytest.approx(when, abs=1e-5)
        assert error.outcome is PainleveOutcome.INDETERMINATE
        assert "Painleve paradox at the contact of floor" in str(error)
    assert plant.events(context) == ()


def test_a_rod_with_friction_lands_and_stays_as_its_equation_says(plant):
    """At 35 degrees there is no paradox: an end that slides keeps lambda = -b / A > 0."""
    start = sliding(0.6)
    start[1] += 0.01
    start[4] = -0.1
    simulator, context = simulator_of(plant, start, step=0.001)
    fall = (np.sqrt(0.01 + 2.0 * GRAVITY * 0.01) - 0.1) / GRAVITY
    simulator.AdvanceTo(fall + 0.002)
    (event,) = plant.events(context)
    assert event.time == pytest.approx(fall, abs=1e-11)
    # The end slides on through the impact, so that m A is as in the class of the rod.
    speed, s, c = 0.1 + GRAVITY * fall, np.sin(0.6), np.cos(0.6)
    mobility = (1.0 + 3.0 * c * c - 4.5 * s * c) / MASS
    assert event.impulses[0] == pytest.approx(speed / mobility)
    *_, angle, slide, rise, turn = plant.state(context)
    assert plant.closed(context) == ("floor",)
    s, c = np.sin(angle), np.cos(angle)
    sliding_speed = slide + HALF * s * turn
    grip = -sliding_speed / np.hypot(sliding_speed, SPEED)
    A = (1.0 + 3.0 * c * c - 3.0 * 1.5 * grip * s * c) / MASS
    force = plant.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(force, (GRAVITY - HALF * s * turn**2) / A, rtol=1e-9)
    assert rise == pytest.approx(HALF * c * turn, abs=1e-9)
