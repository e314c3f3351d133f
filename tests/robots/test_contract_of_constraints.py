"""The rules of `Constraint`, on every member: those of the package and those of `members`.

The robot is a free body with an arm in Drake, whose velocities are no derivatives of positions;
each constraint is made to hold where the robot is. What its forces do is compared with Drake's.
"""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from members import Mirror, Saddle, subclasses
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    MultibodyForces,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
)

from drake_dae import (
    AxisNormalToSurface,
    CoincidentPoints,
    Ellipsoid,
    FixedDistance,
    JointCoupler,
    LinkExpressions,
    Plane,
    PointOnSurface,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    RollingWheel,
)
from drake_dae.robots import (
    Constraint,
    ConstraintSet,
    LoopState,
    MultibodyExpressions,
    WeldedFrames,
)
from drake_dae.trace.functions import TracedFunction

CLOSE = {"rtol": 1e-10, "atol": 1e-10}


@cache
def robot():
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.5, 0.7)
    base, link, rider = (plant.AddRigidBody(name, inertia) for name in ("base", "link", "rider"))
    plant.AddJoint(RpyFloatingJoint("free", plant.world_frame(), base.body_frame()))
    plant.AddJoint(RevoluteJoint("hinge", base.body_frame(), link.body_frame(), [0.6, 0, 0.8]))
    slide = PrismaticJoint("slide", link.body_frame(), rider.body_frame(), [0.48, 0.6, 0.64])
    plant.AddJoint(slide)
    pose = RigidTransform(RollPitchYaw(0.3, -0.7, 1.1), [0.5, 0.2, 0.9])
    plant.AddFrame(FixedOffsetFrame("tip", link.body_frame(), pose))
    plant.Finalize()
    return MultibodyExpressions(plant)


POINT = (0.2, -0.1, 0.3)
Q = np.zeros(8)
"""Where the robot is, for members that are about joints."""


def plane_at(place, _):
    return PointOnSurface("tip", Plane(tuple(place @ POINT), (1.0, 2.0, -2.0)), POINT, "plane")


def rough_at(place, _):
    surface = Plane(tuple(place @ POINT), (1.0, 2.0, -2.0))
    friction = {"friction": 0.4, "stiction_tolerance": 0.05, "viscous_friction": 20.0}
    return PointOnSurface("tip", surface, POINT, "rough", (0.0, 0.0, 0.0), **friction)


def saddle_at(place, _):
    surface = Saddle(tuple(place @ np.array(POINT) - [0.3, 0.1, 0.7 * (0.09 - 0.01)]), 0.7)
    return PointOnSurface("tip", surface, POINT, "saddle")


def pin_at(place, base):
    other = base.inverse() @ (place @ np.array(POINT))
    return CoincidentPoints("base", tuple(other), "tip", POINT, "zx")


def weld_at(place, base):
    return WeldedFrames("base", "tip", base.inverse() @ place)


def turning(place, base, turn, **options):
    """The tip turned in the base about the x axis of a frame that is nobody's own."""
    own = RigidTransform(RollPitchYaw(-0.4, 0.5, 0.9), POINT)
    joint = (
        base.inverse()
        @ place
        @ own
        @ RigidTransform(RollPitchYaw(-turn, 0.0, 0.0), [0.0, 0.0, 0.0])
    )
    point, rpy = joint.translation(), RollPitchYaw(joint.rotation()).vector()
    return RevoluteLoopJoint(
        "base", "tip", "x", tuple(point), tuple(rpy), POINT, (-0.4, 0.5, 0.9), **options
    )


def turning_at(place, base):
    return turning(place, base, 2.5, damping=0.3, stiffness=2.0, rest=1.5, lower=1.0, upper=3.0)


def turning_in_a_plane_at(place, base):
    return turning(place, base, -0.7, planar=True, motor=True, effort_limit=5.0)


def sliding_at(place, base):
    """The tip 0.3 m along the y axis of such a frame."""
    own = RigidTransform(RollPitchYaw(-0.4, 0.5, 0.9), POINT)
    joint = base.inverse() @ place @ own @ RigidTransform([0.0, -0.3, 0.0])
    point, rpy = joint.translation(), RollPitchYaw(joint.rotation()).vector()
    ends = (tuple(point), tuple(rpy), POINT, (-0.4, 0.5, 0.9))
    options = {"motor": True, "lower": 0.0, "upper": 0.5, "velocity_limit": 2.0}
    return PrismaticLoopJoint("base", "tip", "y", *ends, damping=3.0, **options)


def rod_at(place, base):
    other = (0.1, 0.7, -0.2)
    length = np.linalg.norm(place @ np.array(POINT) - base @ np.array(other))
    return FixedDistance("base", other, "tip", POINT, float(length))


def wheel_at(place, _):
    return RollingWheel("tip", 0.2, (0.1, 1.0, 0.2), POINT, (0.1, -0.2, 0.9))


def tilted_at(place, base):
    """The tip's own axis is the normal of an ellipsoid at a point off it."""
    point, centre = place @ np.array(POINT), np.array([-2.0, -1.0, -2.0])
    surface = Ellipsoid(tuple(centre), (0.7, 0.8, 0.9))
    gradient = TracedFunction("n", {"p": (p := ca.SX.sym("p", 3))}, {"n": surface.unit_normal(p)})
    normal = gradient(point - centre)[0]
    own = place.rotation().inverse() @ normal
    return AxisNormalToSurface("tip", surface, tuple(own), POINT, "tilted")


def coupler_at(place, _):
    turn, shift = Q[6:8]
    return JointCoupler("slide", "hinge", -0.3, shift + 0.3 * turn, "m")


def mirror_at(place, base):
    return Mirror(0, 1, Q[0] + Q[1])


# How to make it where the robot is, and the frames that its forces act on.
MEMBERS = {
    "plane": (plane_at, {"tip", "world"}),
    "saddle": (saddle_at, {"tip", "world"}),
    "pin": (pin_at, {"tip", "base"}),
    "weld": (weld_at, {"tip", "base"}),
    "revolute": (turning_at, {"tip", "base"}),
    "planar revolute": (turning_in_a_plane_at, {"tip", "base"}),
    "prismatic": (sliding_at, {"tip", "base"}),
    "rod": (rod_at, {"tip", "base"}),
    "rough": (rough_at, {"tip", "world"}),
    "wheel": (wheel_at, {"tip", "world"}),
    "tilted": (tilted_at, {"tip", "world"}),
    "coupler": (coupler_at, {"rider", "link", "base"}),
    "mirror": (mirror_at, set()),
}


def test_no_member_is_left_out():
    place = RigidTransform()
    tested = {type(make(place, place)) for make, _ in MEMBERS.values()}
    assert subclasses(Constraint) <= tested


@cache
def case(name):
    """A constraint that holds at a random configuration, and its expressions there."""
    links, random = robot(), np.random.default_rng(0)
    plant = links.plant
    context = plant.CreateDefaultContext()
    q, v = random.uniform(-1.0, 1.0, (2, 8))
    Q[:] = q
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
    wrenches, signals = ConstraintSet([constraint]).wrenches(kinematics, force)
    parts = [*links.parameters, *constraint.parameters]
    symbols = ca.vertcat(*[p.symbol for p in parts])
    function = TracedFunction(
        name,
        {"q": links.q, "v": links.v, "force": force, "parameters": symbols},
        {
            "residual": plain,
            "plain rate": ca.jtimes(plain, links.q, speed),
            "rate": kinematics.value(rate),
            "jacobian": ca.jacobian(kinematics.value(rate), links.v),
            "tau": links.generalized_force(kinematics, reaction),
            "drag": ConstraintSet([constraint]).drag(links),
            "wrenches": wrenches,
        },
    )
    frames = [signal.name.split(".")[1] for signal in signals[::6]]
    values = np.concatenate([p.value for p in (*links.parameters, *constraint.parameters)])
    load = random.uniform(1.0, 50.0, force.numel())

    def evaluate(v=v, load=load):
        return dict(zip(function.output_names, function(q, v, load, values), strict=True))

    return constraint, evaluate, context, v, load, frames


# The rules, each for what `case` knows of a member.


def rows_are_as_many_as_names(given):
    _, constraint, evaluate, *_ = given
    found, count = evaluate(), len(constraint.force_signals)
    assert len(constraint.residual_signals) == len(constraint.is_unilateral) == count
    assert found["rate"].shape == (count,)
    assert found["residual"].size <= count
    names = [s.name for s in (*constraint.force_signals, *constraint.residual_signals)]
    names += [p.name for p in constraint.parameters]
    assert len(set(names)) == len(names)
    assert all(name.startswith(f"{constraint.name}.") for name in names)


def it_holds_and_its_rate_is_the_derivative(given):
    _, _, evaluate, *_ = given
    found = evaluate()
    np.testing.assert_allclose(found["residual"], 0.0, atol=1e-12)
    rate = found["rate"][: found["residual"].size]
    np.testing.assert_allclose(rate, found["plain rate"], **CLOSE)


def rate_is_linear_in_velocities(given):
    _, _, evaluate, _, v, *_ = given
    np.testing.assert_allclose(evaluate(v=-3.0 * v)["rate"], -3.0 * evaluate()["rate"], **CLOSE)


def reaction_is_linear_and_does_the_work_of_the_rate(given):
    """Friction takes some: tau . v = lambda . rate without it, and less with it."""
    _, constraint, evaluate, _, v, load, _ = given
    found = evaluate()
    np.testing.assert_allclose(evaluate(load=2.0 * load)["tau"], 2.0 * found["tau"], **CLOSE)
    work, ideal = found["tau"] @ v, load @ found["rate"]
    if constraint.is_ideal:
        assert work == pytest.approx(ideal, abs=1e-9)
    else:
        assert work < ideal - 0.1
    assert found["drag"] @ v <= 0.0
    assert np.any(found["drag"]) == (constraint.name == "rough")


def wrenches_act_on_the_frames_that_it_connects(given):
    name, *_, frames = given
    assert set(frames) == MEMBERS[name][1]


def reaction_is_what_its_wrenches_do(given):
    """On all its frames at once, at their origins, by Drake; together they balance."""
    _, _, evaluate, context, _, _, frames = given
    if not frames:
        return
    plant, found = robot().plant, evaluate()
    forces, total = MultibodyForces(plant), np.zeros(6)
    for name, wrench in zip(frames, found["wrenches"].reshape(-1, 6), strict=True):
        frame = plant.GetFrameByName(name)
        place = frame.CalcPoseInWorld(context).translation()
        lever = place - frame.body().EvalPoseInWorld(context).translation()
        acting = SpatialForce(wrench[:3], wrench[3:])
        frame.body().AddInForce(context, lever, acting, plant.world_frame(), forces)
        total += np.concatenate([wrench[:3] + np.cross(place, wrench[3:]), wrench[3:]])
    expected = plant.CalcGeneralizedForces(context, forces)
    np.testing.assert_allclose(found["tau"] + found["drag"], expected, **CLOSE)
    np.testing.assert_allclose(total, 0.0, atol=1e-10)


def wrenches_take_no_power_where_the_constraint_holds(given):
    """Rule 9, by Drake's velocities of the frames, at a velocity that keeps the rate at zero.

    Without friction the power is 0; the numbers that cancel are of order 1e2, so 1e-9 is round-off
    with room. Friction takes power.
    """
    _, constraint, evaluate, context, v, _, frames = given
    if not frames:
        return
    plant = robot().plant
    jacobian = evaluate()["jacobian"].reshape(-1, v.size)
    kept = v - np.linalg.pinv(jacobian) @ jacobian @ v
    found = evaluate(v=kept)
    np.testing.assert_allclose(found["rate"], 0.0, atol=1e-12)
    plant.SetVelocities(context, kept)
    power = 0.0
    for name, wrench in zip(frames, found["wrenches"].reshape(-1, 6), strict=True):
        moving = plant.GetFrameByName(name).CalcSpatialVelocityInWorld(context)
        power += wrench[:3] @ moving.rotational() + wrench[3:] @ moving.translational()
    assert np.linalg.norm(found["wrenches"]) > 1.0
    assert np.linalg.norm(kept) > 0.1
    if constraint.is_ideal:
        assert power == pytest.approx(0.0, abs=1e-9)
    else:
        assert power < -0.1


def coordinates_are_as_many_as_names(given):
    _, constraint, *_ = given
    assert constraint.coordinates(robot()).numel() == len(constraint.coordinate_signals)


JOINTS = {"revolute": 2.5, "planar revolute": -0.7, "prismatic": 0.3}
"""The members that are joints, and their coordinates."""


def a_joint_has_a_coordinate_with_a_rate_that_is_power_of_a_unit_force(given):
    """At any velocity where the positions keep the constraint."""
    name, constraint, _, context, v, *_ = given
    if name not in JOINTS:
        return
    links, plant = robot(), robot().plant
    loop = LoopState(ConstraintSet([constraint]), links)
    if name == "prismatic":
        np.testing.assert_array_equal(loop.limits, [[0.0, -2.0], [0.5, 2.0]])
    plain = ca.jtimes(constraint.coordinates(links), links.q, links.velocity_map @ links.v)
    symbols = ca.vertcat(*[p.symbol for p in (*links.parameters, *constraint.parameters)])
    function = TracedFunction(
        name,
        {"q": links.q, "v": links.v, "parameters": symbols},
        {"state": loop.state, "plain": plain, "column": loop.columns},
    )
    values = np.concatenate([p.value for p in (*links.parameters, *constraint.parameters)])
    (c, speed), derivative, column = function(plant.GetPositions(context), v, values)
    assert c == pytest.approx(JOINTS[name], abs=1e-12)
    assert speed == pytest.approx(column @ v, abs=1e-12)
    assert derivative.item() == pytest.approx(speed, abs=1e-10)
    assert abs(speed) > 1e-3
    expected = -0.3 * speed - 2.0 * (c - 1.5) if name == "revolute" else None
    if expected is not None:
        symbol = ca.SX.sym("c", 2)
        force = TracedFunction(
            name, {"c": symbol, "p": symbols}, {"f": constraint.force(symbol[0], symbol[1])}
        )(np.array([c, speed]), values)[0]
        np.testing.assert_allclose(force, expected, rtol=1e-12)


RULES = (
    rows_are_as_many_as_names,
    it_holds_and_its_rate_is_the_derivative,
    rate_is_linear_in_velocities,
    reaction_is_linear_and_does_the_work_of_the_rate,
    wrenches_act_on_the_frames_that_it_connects,
    reaction_is_what_its_wrenches_do,
    wrenches_take_no_power_where_the_constraint_holds,
    coordinates_are_as_many_as_names,
    a_joint_has_a_coordinate_with_a_rate_that_is_power_of_a_unit_force,
)


@pytest.mark.equation(38)
@pytest.mark.equation(41)
@pytest.mark.parametrize("name", MEMBERS)
def test_each_rule(name):
    for rule in RULES:
        rule((name, *case(name)))


def test_a_push_drives_the_residual_up():
    """Rule 5: phi'' of a positive force alone, J M^-1 G lambda, is positive."""
    links, found = robot(), set()
    for name in MEMBERS:
        constraint, _, context, v, *_ = case(name)
        pushing = [i for i, pushes in enumerate(constraint.is_unilateral) if pushes]
        if not pushing:
            continue
        found.add(name)
        G = ConstraintSet([constraint]).force_matrix(links)[:, pushing]
        J = ca.jacobian(constraint.residual(links)[pushing], links.q) @ links.velocity_map
        symbols = ca.vertcat(*[p.symbol for p in (*links.parameters, *constraint.parameters)])
        values = np.concatenate([p.value for p in (*links.parameters, *constraint.parameters)])
        rows, columns = TracedFunction(
            name, {"q": links.q, "v": links.v, "p": symbols}, {"J": J, "G": G}
        )(links.plant.GetPositions(context), v, values)
        up = rows.reshape(-1) @ np.linalg.solve(links.plant.CalcMassMatrix(context), columns)
        assert up > 0.0
    assert found == {"plane", "saddle", "rough"}


def pole():
    """A body in the x-z plane, q = (x, z, angle about -y): its z axis is (-sin, 0, cos)."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, -s), ca.horzcat(0, 1, 0), ca.horzcat(s, 0, c))
    place = ca.vertcat(q[0], 0, q[1])
    return LinkExpressions(
        q, v, ca.diag(ca.SX([2, 2, 0.3])), ca.SX(3, 1), {"body": (turned, place)}
    )


def rows(constraint, links, q):
    function = TracedFunction(
        "rows",
        {"q": links.q, "p": ca.vertcat(*[p.symbol for p in constraint.parameters])},
        {"phi": constraint.residual(links), "J": ca.jacobian(constraint.residual(links), links.q)},
    )
    return function(q, np.concatenate([p.value for p in constraint.parameters]))


@pytest.mark.parametrize("angle", [-2.5, -0.4, 0.0, 0.3, 1.9])
def test_it_measures_the_tilt_and_has_no_second_zero(angle):
    """2 tan(t / 2) of the tilt t against the normal, whose other end is infinitely far.

    axes_along(z) are x and y, and a tilt about -y is one about -c: phi = (0, 2 tan(-t / 2)).
    """
    links = pole()
    constraint = AxisNormalToSurface("body", Plane((0, 0, 0), (0, 0, 1)))
    phi, _ = rows(constraint, links, [0.3, 0.1, angle])
    np.testing.assert_allclose(phi, [0.0, -2.0 * np.tan(angle / 2.0)], atol=1e-13)
