"""The Painleve paradox of frictional contacts, against closed forms.

The rod: uniform, of length 2 l and mass m, one end on a rough floor, at an angle a to it. With the
friction of an end that slides toward -x, J M^-1 J^T = (1 + 3 cos^2 a) / m and
J M^-1 J_t^T = -3 sin a cos a / m, so that

    m A = 1 + 3 cos^2 a - 3 mu sin a cos a,    mu_crit = (1 + 3 cos^2 a) / (3 sin a cos a),

which is least at tan a = 2, where it is 4/3.
"""

import casadi as ca
import numpy as np
import pytest
from arms import error_controlled
from numpy.testing import assert_allclose
from runs import some

from drake_dae import (
    ConstantReference,
    JointPositions,
    LinkExpressions,
    Plane,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.dae import Parameter, Signal, UnilateralInput
from drake_dae.dae.contacts import Contacts, critical_factor
from drake_dae.dae.margins import ContactMargins
from drake_dae.errors import PainleveError
from drake_dae.trace.functions import TracedFunction

MASS, HALF, GRAVITY, SPEED = 1.3, 0.5, 9.81, 1e-3


def rod(friction, angle=1.0):
    """A rod in the x-z plane with positions (x, z, angle), moved by a force and a torque."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, -s), ca.horzcat(0, 1, 0), ca.horzcat(s, 0, c))
    links = LinkExpressions(
        q,
        v,
        ca.diag(ca.SX([MASS, MASS, MASS * HALF**2 / 3.0])),
        ca.SX([0.0, MASS * GRAVITY, 0.0]),
        frames={"rod": (turned, ca.vertcat(q[0], 0.0, q[1]))},
    )
    floor = PointOnSurface(
        "rod", Plane((0, 0, 0), (0, 0, 1)), (-HALF, 0, 0), "floor", None, friction, SPEED
    )
    nominal = [0.0, HALF * np.sin(angle), angle]
    outputs = [JointPositions(["q0", "q2"])]
    return RobotModel(links, [floor], outputs, nominal)


def sliding(angle, turn=0.0):
    """The rod's state, its end on the floor."""
    height, rise = HALF * np.sin(angle), HALF * np.cos(angle) * turn
    return np.array([0.0, height, angle, -2.0 - HALF * np.sin(angle) * turn, rise, turn])


def critical(angle):
    return (1.0 + 3.0 * np.cos(angle) ** 2) / (3.0 * np.sin(angle) * np.cos(angle))


def margin_of(mu, angle):
    return 1.0 - mu / critical(angle)


@pytest.fixture(scope="module")
def steep():
    """A rod with the Painleve paradox between 50 and 76 degrees."""
    return RobotPlant(rod(1.5))


def context_of(plant, state):
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(3))
    plant.set_state(context, state)
    return context


@pytest.mark.parametrize("angle", some([0.3, 0.8, 1.0, 1.4], of=3))
@pytest.mark.parametrize("friction", [0.0, 0.8])
def test_the_margin_has_the_critical_coefficient_at_a_state(angle, friction):
    """mu_crit in closed form; s is 1 except for (v_s / v)^2 / 2 = 1e-7. Without friction, too."""
    system = rod(friction).dae
    margins = ContactMargins(system, find_structure(system).elimination.constraint_matrix)
    found = margins.at(sliding(angle), system.parameter_values)
    assert found.critical_friction["floor.friction"] == pytest.approx(critical(angle), rel=1e-6)
    assert found.reserve == pytest.approx(margin_of(friction, angle), abs=1e-6)
    assert not found.is_paradoxical


@pytest.mark.parametrize("turn", [0.0, 6.0])
def test_in_the_paradox_a_rod_has_no_motion_or_two(steep, turn):
    """b = l sin a a'^2 - g: a rod at rest would pierce the floor, one that turns fast lifts off."""
    state = sliding(1.1, turn)
    with pytest.raises(PainleveError, match=r"'floor\.force'") as caught:
        steep.EvalTimeDerivatives(context_of(steep, state))
    assert_allclose(caught.value.state, state)


def test_outside_of_the_paradox_a_rod_moves_as_by_hand(steep):
    """At 80 degrees mu_crit is 2.1: lambda = -b / A."""
    angle, turn = np.deg2rad(80.0), 0.7
    context = context_of(steep, sliding(angle, turn))
    A = margin_of(1.5, angle) * (1.0 + 3.0 * np.cos(angle) ** 2) / MASS
    expected = (GRAVITY - HALF * np.sin(angle) * turn**2) / A
    force = steep.GetOutputPort("constraint_force").Eval(context)
    assert force[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_a_run_that_reaches_the_edge_stops_there():
    """Under a law that knows the friction lambda stays 5 N, so b = -A lambda: beyond, two fit.

    tan a = (9 + 17^(1/2)) / 4 where 3 mu t = t^2 + 4 with mu = 1.5, and a(t) is as commanded.
    """
    model = rod(1.5, np.deg2rad(80.0))
    law = TrackingLaw(model.dae, poles(-6.0))
    # It slides at a constant speed and falls from 80 degrees to 40 within 4 s.
    path = SinusoidReference(np.deg2rad(60.0), np.deg2rad(20.0), np.pi / 4.0, np.pi / 2.0)
    references = [SinusoidReference(0.0, -200.0, 1e-2), path, ConstantReference(5.0)]
    loop = make_closed_loop(RobotPlant(model, structure=law.structure), law, references)
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_consistent_state(own, sliding(np.deg2rad(80.0)))
    with pytest.raises(PainleveError) as caught:
        simulate(loop.diagram, context, 3.5, error_controlled(1e-8))
    angle = np.arctan((9.0 + np.sqrt(17.0)) / 4.0)
    when = np.arccos((np.rad2deg(angle) - 60.0) / 20.0) / (np.pi / 4.0)
    assert caught.value.time == pytest.approx(when, abs=1e-5)
    assert caught.value.state[2] == pytest.approx(angle, abs=1e-5)


# Several contacts: P-matrices.


def minors(matrix, rows):
    kept = [i for i in range(len(matrix)) if i not in rows]
    sets = [np.flatnonzero(bits) for bits in np.ndindex(*(2,) * len(rows)) if any(bits)]
    sets = [[*kept, *np.array(rows)[chosen]] for chosen in sets]
    return np.array([np.linalg.det(matrix[np.ix_(s, s)]) for s in sets])


@pytest.mark.parametrize("seed", range(8))
def test_the_reserve_is_positive_exactly_for_a_p_matrix(seed):
    """Against all principal minors, of contacts 1, 2 and 4 of four constraints and more or less
    friction; the critical factor is where one of them comes to zero."""
    random = np.random.default_rng(seed)
    root = random.standard_normal((4, 6))
    A_0, rows = root @ root.T, [0, 1, 3]
    D = A_0 @ np.diag([1, 1, 0, 1]) * random.uniform(-1.0, 1.0, (4, 4))
    mu = ca.SX.sym("mu")
    parameter = Parameter("mu", np.array([0.0]), symbol=mu)
    names = [Signal(name) for name in "abcd"]
    contacts = Contacts("x", names, [parameter], [UnilateralInput(n, "mu") for n in "abd"])
    assert contacts.rows == rows
    function = TracedFunction("r", {"mu": mu}, {"r": contacts.reserve(ca.SX(A_0) - mu * D)})
    critical = critical_factor(A_0, D, rows)
    for share in (0.3, 0.99, 1.01):
        friction = share * critical if np.isfinite(critical) else 10.0 * share
        reserve = function([friction])[0].item()
        assert (reserve > 0.0) == bool(np.all(minors(A_0 - friction * D, rows) > 0.0))
        assert (reserve > 0.0) == (share < 1.0 or not np.isfinite(critical))
