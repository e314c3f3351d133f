"""The rules of `Constraint`, on every member: those of the package and those of `members`.

The robot is a free body with an arm in Drake, whose velocities are no derivatives of positions;
each constraint is made to hold where the robot is. What its forces do is compared with Drake's.
"""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from members import Coupler, FixedDistance, RubbingPoint, Saddle, Skate, subclasses
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    MultibodyForces,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
)

from drake_dae import CoincidentPoints, MultibodyExpressions, Plane, PointOnSurface, Sphere
from drake_dae.errors import ModelError
from drake_dae.robots.contact import Application, Constraint, WeldedFrames
from drake_dae.robots.contact.constraint_set import ConstraintSet
from drake_dae.trace.functions import TracedFunction

CLOSE = {"rtol": 1e-10, "atol": 1e-10}


@cache
def robot():
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.5, 0.7)
    base, link = plant.AddRigidBody("base", inertia), plant.AddRigidBody("link", inertia)
    plant.AddJoint(RpyFloatingJoint("free", plant.world_frame(), base.body_frame()))
    plant.AddJoint(RevoluteJoint("hinge", base.body_frame(), link.body_frame(), [0.6, 0, 0.8]))
    pose = RigidTransform(RollPitchYaw(0.3, -0.7, 1.1), [0.5, 0.2, 0.9])
    plant.AddFrame(FixedOffsetFrame("tip", link.body_frame(), pose))
    plant.Finalize()
    return MultibodyExpressions(plant)


POINT = (0.2, -0.1, 0.3)


def plane_at(place, _):
    return PointOnSurface("tip", Plane(tuple(place @ POINT), (1.0, 2.0, -2.0)), POINT, "plane")


def ball_at(place, _):
    center = place @ np.array(POINT) + [0.0, 0.3, 0.4]
    return PointOnSurface("tip", Sphere(tuple(center), 0.5, inside=True), POINT, "ball")


def rubbing_at(place, _):
    surface = Plane(tuple(place @ POINT), (1.0, 2.0, -2.0))
    return RubbingPoint("tip", surface, POINT, "rubbing", friction=0.4)


def saddle_at(place, _):
    surface = Saddle(tuple(place @ np.array(POINT) - [0.3, 0.1, 0.7 * (0.09 - 0.01)]), 0.7)
    return PointOnSurface("tip", surface, POINT, "saddle")


def pin_at(place, base):
    other = base.inverse() @ (place @ np.array(POINT))
    return CoincidentPoints("base", tuple(other), "tip", POINT, "zx")


def weld_at(place, base):
    return WeldedFrames("base", "tip", base.inverse() @ place)


def rod_at(place, base):
    other = (0.1, 0.7, -0.2)
    length = np.linalg.norm(place @ np.array(POINT) - base @ np.array(other))
    return FixedDistance("base", other, "tip", POINT, float(length))


def skate_at(place, _):
    return Skate("tip")


def coupler_at(place, base):
    turns = RollPitchYaw(base.rotation())
    return Coupler(0, 1, 2.0, turns.roll_angle() + 2.0 * turns.pitch_angle())


# How to make it where the robot is, the frame that its forces act on, and what gets the opposite.
MEMBERS = {
    "plane": (plane_at, "tip", "world"),
    "ball": (ball_at, "tip", "world"),
    "saddle": (saddle_at, "tip", "world"),
    "pin": (pin_at, "tip", "base"),
    "weld": (weld_at, "tip", "base"),
    "rod": (rod_at, "tip", "base"),
    "rubbing": (rubbing_at, "tip", "world"),
    "skate": (skate_at, "tip", "world"),
    "coupler": (coupler_at, "tip", "world"),
}


def test_no_member_is_left_out():
    place = RigidTransform()
    tested = {type(make(place, place)) for make, _, _ in MEMBERS.values()}
    assert subclasses(Constraint) <= tested


@cache
def case(name, seed):
    """A constraint that holds at a random configuration, and its expressions there."""
    links, random = robot(), np.random.default_rng(seed)
    plant = links.plant
    context = plant.CreateDefaultContext()
    q, v = random.uniform(-1.0, 1.0, (2, 7))
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    frames = [plant.GetFrameByName(frame) for frame in ("tip", "base")]
    constraint = MEMBERS[name][0](*[frame.CalcPoseInWorld(context) for frame in frames])
    kinematics = links.kinematics()
    force = ca.SX.sym("force", len(constraint.force_signals))
    rate = constraint.rate(kinematics)
    reaction = constraint.reaction(kinematics, force)
    plain = constraint.residual(links)
    speed = links.velocity_map @ links.v
    application = constraint.application(kinematics) or Application(*[ca.SX(3, 1)] * 3)
    symbols = ca.vertcat(*[p.symbol for p in (*links.parameters, *constraint.parameters)])
    function = TracedFunction(
        name,
        {"q": links.q, "v": links.v, "force": force, "parameters": symbols},
        {
            "residual": plain,
            "plain rate": ca.jtimes(plain, links.q, speed),
            "rate": kinematics.value(rate),
            "tau": links.generalized_force(kinematics, reaction),
            "point": kinematics.value(application.point),
            "F": kinematics.value(application.force_axes @ force),
            "M": kinematics.value(application.moment_axes @ force),
        },
    )
    values = np.concatenate([p.value for p in (*links.parameters, *constraint.parameters)])
    load = random.uniform(1.0, 50.0, force.numel())

    def evaluate(v=v, load=load):
        return dict(zip(function.output_names, function(q, v, load, values), strict=True))

    return constraint, evaluate, context, v, load


@pytest.fixture(params=[(name, seed) for name in MEMBERS for seed in range(3)])
def given(request):
    return request.param[0], *case(*request.param)


def test_rows_are_as_many_as_names(given):
    _, constraint, evaluate, *_ = given
    found, count = evaluate(), len(constraint.force_signals)
    assert len(constraint.residual_signals) == len(constraint.can_only_push) == count
    assert found["rate"].shape == (count,)
    assert found["residual"].shape in ((count,), (0,))
    names = [s.name for s in (*constraint.force_signals, *constraint.residual_signals)]
    names += [p.name for p in constraint.parameters]
    assert len(set(names)) == len(names)
    assert all(name.startswith(f"{constraint.name}.") for name in names)


def test_it_holds_and_its_rate_is_the_derivative(given):
    _, _, evaluate, *_ = given
    found = evaluate()
    np.testing.assert_allclose(found["residual"], 0.0, atol=1e-12)
    if found["residual"].size:
        np.testing.assert_allclose(found["rate"], found["plain rate"], **CLOSE)


def test_rate_is_linear_in_velocities(given):
    _, _, evaluate, _, v, _ = given
    np.testing.assert_allclose(evaluate(v=-3.0 * v)["rate"], -3.0 * evaluate()["rate"], **CLOSE)


def test_reaction_is_linear_and_does_the_work_of_the_rate(given):
    """Friction takes some: tau . v = lambda . rate without it, and less with it."""
    name, _, evaluate, _, v, load = given
    found = evaluate()
    np.testing.assert_allclose(evaluate(load=2.0 * load)["tau"], 2.0 * found["tau"], **CLOSE)
    work, ideal = found["tau"] @ v, load @ found["rate"]
    if name == "rubbing":
        assert work < ideal - 0.1
    else:
        assert work == pytest.approx(ideal, abs=1e-9)


def test_reaction_is_the_force_and_moment_of_its_application(given):
    """On the one frame at the point, and the opposite on the other, by Drake."""
    name, constraint, evaluate, context, _, _ = given
    if constraint.application(robot().kinematics()) is None:
        return
    plant, found = robot().plant, evaluate()
    forces = MultibodyForces(plant)
    for frame, sign in zip(MEMBERS[name][1:], (1.0, -1.0), strict=True):
        body = plant.GetFrameByName(frame).body()
        lever = found["point"] - body.EvalPoseInWorld(context).translation()
        acting = SpatialForce(sign * found["M"], sign * found["F"])
        body.AddInForce(context, lever, acting, plant.world_frame(), forces)
    expected = plant.CalcGeneralizedForces(context, forces)
    np.testing.assert_allclose(found["tau"], expected, **CLOSE)


def test_coordinates_are_as_many_as_names_or_refused(given):
    _, constraint, *_ = given
    if constraint.coordinate_signals:
        assert constraint.coordinates(robot()).numel() == len(constraint.coordinate_signals)
    else:
        with pytest.raises(ModelError, match="has no coordinates"):
            constraint.coordinates(robot())


def test_a_push_drives_the_residual_up():
    """Rule 5: phi'' of a positive force alone, J M^-1 G lambda, is positive."""
    links = robot()
    for name in ("plane", "ball", "saddle", "rubbing"):
        constraint, _, context, v, _ = case(name, 0)
        assert constraint.can_only_push == (True,)
        G = ConstraintSet([constraint]).force_matrix(links)
        J = ca.jacobian(constraint.residual(links), links.q) @ links.velocity_map
        symbols = ca.vertcat(*[p.symbol for p in (*links.parameters, *constraint.parameters)])
        values = np.concatenate([p.value for p in (*links.parameters, *constraint.parameters)])
        rows, columns = TracedFunction(
            name, {"q": links.q, "v": links.v, "p": symbols}, {"J": J, "G": G}
        )(links.plant.GetPositions(context), v, values)
        up = rows.reshape(-1) @ np.linalg.solve(links.plant.CalcMassMatrix(context), columns)
        assert up > 0.0
