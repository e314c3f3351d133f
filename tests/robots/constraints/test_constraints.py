"""Constraints against MultibodyPlant: what their Jacobians are, and what their multipliers do.

Drake and the library compute the same numbers of order 1 to 100 by different recursions, so the
tolerance of 1e-10 is round-off with room.
"""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import JacobianWrtVariable
from two_arms import APART, NOMINAL, two_arms

from drake_dae import CoincidentPoints, LinkExpressions, WeldedFrames, find_structure
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

VELOCITY = JacobianWrtVariable.kV
PAIRS = [("right::link5", "left::link3"), ("right::tool", "world")]


@cache
def arms():
    model = two_arms()
    return model, find_structure(model.dae)


def evaluate(constraint, links, q):
    """phi and J = (dphi/dq) N at a configuration, shapes (m,) and (m, nv)."""
    phi = constraint.residual(links)
    symbols = ca.vertcat(ca.SX(0, 1), *[p.symbol for p in constraint.parameters])
    function = TracedFunction(
        constraint.name,
        {"q": links.q, "p": symbols},
        {"phi": phi, "jacobian": ca.mtimes(ca.jacobian(phi, links.q), links.velocity_map)},
    )
    values = np.concatenate([np.zeros(0), *[p.value for p in constraint.parameters]])
    residual, jacobian = function(q, values)
    assert len(residual) == len(constraint.force_signals) == len(constraint.residual_signals)
    return residual, jacobian.reshape(len(residual), -1)


def configurations(count, seed=0):
    """Random ones of the two arms, with Drake's context there."""
    plant = arms()[0].links.plant
    random = np.random.default_rng(seed)
    for _ in range(count):
        q = random.uniform(-2.0, 2.0, plant.num_positions())
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, q)
        yield q, context, random


def frames(*names):
    """Of the two arms, by scoped name."""
    plant = arms()[0].links.plant
    for name in names:
        *instance, own = name.split("::")
        yield plant.GetFrameByName(own, *map(plant.GetModelInstanceByName, instance))


def random_pose(random):
    return RigidTransform(RollPitchYaw(random.uniform(-1, 1, 3)), random.uniform(-1, 1, 3))


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_weld_measures_a_pose_and_its_rate_the_relative_velocity(first, second):
    """Anywhere, also far off the constraint: phi from Drake's angle and axis, and

    r' = w + w x r / 2 + (w . r) r / 4.
    """
    links = arms()[0].links
    a, b = frames(first, second)
    for q, context, random in configurations(5):
        pose = random_pose(random)
        phi, jacobian = evaluate(WeldedFrames(first, second, pose), links, q)
        found = links.plant.CalcRelativeTransform(context, a, b)
        turn = (found.rotation() @ pose.rotation().inverse()).ToAngleAxis()
        r = 2.0 * np.tan(turn.angle() / 2.0) * turn.axis()
        scale = 1.0 + r @ r  # Where phi goes to infinity, its errors do.
        np.testing.assert_allclose(phi[:3], found.translation() - pose.translation(), atol=1e-10)
        np.testing.assert_allclose(phi[3:], r, atol=1e-10 * scale)
        velocity = links.plant.CalcJacobianSpatialVelocity(context, VELOCITY, b, np.zeros(3), a, a)
        turning = np.eye(3) - _cross(r) / 2.0 + np.outer(r, r) / 4.0
        np.testing.assert_allclose(jacobian[:3], velocity[3:], atol=1e-10)
        np.testing.assert_allclose(jacobian[3:], turning @ velocity[:3], atol=1e-10 * scale)


def turntable():
    """One joint about z."""
    q, v = ca.SX.sym("q"), ca.SX.sym("v")
    c, s = ca.cos(q), ca.sin(q)
    rotation = ca.SX(3, 3)
    rotation[0, 0], rotation[0, 1], rotation[1, 0], rotation[1, 1], rotation[2, 2] = c, -s, s, c, 1
    pose = (rotation, ca.SX.zeros(3))
    return LinkExpressions(
        q, v, ca.SX(1), ca.SX(0), frames={"plate": pose, "point": ca.SX.zeros(3)}
    )


def test_weld_has_no_other_root():
    """The orientation error grows up to half a turn, where it is infinite."""
    turns = [*np.linspace(0.0, 3.14, 50), np.pi]
    sizes = [evaluate(WeldedFrames("world", "plate"), turntable(), [q])[0][5] for q in turns]
    assert np.all(np.diff(sizes) >= np.diff(turns))
    assert sizes[-1] == np.inf
    model = arms()[0]
    midway = [APART / 2, 0.0, 0.4, *np.zeros(5)]
    # From a right hand that is turned by nearly half a turn, Newton's method turns it back.
    for turn in (-3.0, -1.6, 1.6, 3.0):
        guess = NOMINAL + turn * np.eye(14)[13]
        np.testing.assert_allclose(model.configuration(midway, guess), NOMINAL, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CoincidentPoints("a", (0, 0, 0), "b", (0, 0, 0), "xx"), "'xx'"),
        (lambda: WeldedFrames("a", "b", RigidTransform([np.inf, 0, 0])), r"weld\.position"),
        (lambda: WeldedFrames("world", "plat").residual(turntable()), "'plat'"),
        (lambda: WeldedFrames("world", "point").residual(turntable()), "point"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ModelError, match=message):
        make()


def _cross(vector):
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
