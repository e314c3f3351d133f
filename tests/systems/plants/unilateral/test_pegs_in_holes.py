"""A peg in a hole with clearance, in ideal contact, beside closed forms and the body of a plate."""

import casadi as ca
import numpy as np
import pytest
from falling import GRAVITY, simulator_of
from numpy.testing import assert_allclose
from pegs import ARM, HOLE, INERTIA, MASS, peg_of, planar_peg, plate_of, upright_peg
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RpyFloatingJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from runs import in_equal_steps

from drake_dae import (
    ConstantReference,
    MultibodyExpressions,
    Peg,
    Plane,
    PointOnSurface,
    ReferenceGenerator,
    RobotModel,
    SinusoidReference,
    UnilateralRobotPlant,
)
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.systems.plants.contact_events import ContactChange
from drake_dae.systems.plants.pegs.hole import peg_in_hole
from drake_dae.trace.functions import TracedFunction

CLEARANCE, CHAMFER = 1e-4, 1e-3


def plant_of(model, restitution=0.0, clearance=CLEARANCE):
    return UnilateralRobotPlant(model, {"wall": restitution}, pegs=[peg_of(clearance)])


def value(plant, context, port):
    return plant.GetOutputPort(port).Eval(context)


def standing(tip_x, tip_z, angle):
    """The state at rest of a planar peg with a place of its end, and an angle."""
    x, z = tip_x + ARM * np.sin(angle), tip_z + ARM * np.cos(angle)
    return np.array([x, z, angle, 0.0, 0.0, 0.0])


def two_points(depth, chamfer, clearance):
    """A planar peg at rest that touches with its end and with its side at the rim.

    Its axis passes through (-c, -depth) and (c, -chamfer).
    """
    angle = np.arctan(2.0 * clearance / (depth - chamfer))
    return standing(-clearance, -depth, angle), angle


@pytest.mark.slow
def test_a_peg_beside_its_hole_hits_the_chamfer_and_slides_into_the_hole():
    """From 2 mm above the face, 0.5 mm off the axis of the hole.

    The cone is 0.6 mm below the face there. The normal (-1, 0, 1) / sqrt(2) at the end of the peg
    turns it too, so the impact of the speed v is v / sqrt(2) / (1 / M + ARM^2 / (2 I)).
    """
    plant = plant_of(planar_peg(driven=False))
    simulator, context = simulator_of(plant, standing(5e-4, 2e-3, 0.0), 1e-3, 1e-9)
    simulator.AdvanceTo(0.05)
    first, *_ = events = plant.events(context)
    fall = 2e-3 + CLEARANCE + CHAMFER - 5e-4
    assert first.contacts == ("wall.chamfer",)
    assert_allclose(first.time, np.sqrt(2.0 * fall / GRAVITY), rtol=0.0, atol=1e-10)
    mobility = 1.0 / MASS + ARM**2 / (2.0 * INERTIA)
    assert_allclose(first.impulses, np.sqrt(GRAVITY * fall) / mobility, rtol=1e-9)
    # It leaves the cone at its lower end, and hits the far side of the hole.
    assert [event.kind for event in events[1:3]] == [ContactChange.OPENING, ContactChange.IMPACT]
    assert [event.contacts for event in events[1:3]] == [("wall.chamfer",), ("wall.side",)]
    x, z, angle = plant.state(context)[:3]
    assert z - ARM * np.cos(angle) < -CHAMFER
    assert abs(x - ARM * np.sin(angle)) <= CLEARANCE + 1e-12


def test_a_peg_over_its_hole_touches_nothing_and_one_beside_it_stands_on_the_face():
    plant = plant_of(planar_peg(driven=False))
    for start, force in ((0.99 * CLEARANCE, 0.0), (CLEARANCE + 1.01 * CHAMFER, MASS * GRAVITY)):
        simulator, context = simulator_of(plant, standing(start, 1e-3, 0.0), 1e-3, 1e-9)
        simulator.AdvanceTo(0.03)
        assert bool(plant.events(context)) == bool(force)
        assert_allclose(value(plant, context, "constraint_force"), force, rtol=1e-9)
        assert_allclose(value(plant, context, "hole_force"), 0.0)
        assert_allclose(value(plant, context, "mode"), bool(force))


@pytest.mark.parametrize(
    ("place", "depth", "angle"),
    [(2.0 * CLEARANCE, 5e-3, 0.0), (0.0, 5e-3, 0.1), (5e-4, 7e-4, 0.0), (2e-3, 1e-4, 0.0)],
)
def test_a_start_inside_the_plate_is_refused(place, depth, angle):
    """With its end in the side, its shank in the rim, its end in the chamfer or in the face."""
    with pytest.raises(InconsistentStateError, match="inside the surface of 'wall"):
        simulator_of(plant_of(planar_peg()), standing(place, -depth, angle))


@pytest.mark.parametrize(("depth", "chamfer"), [(0.015, 0.001), (0.008, 0.0)])
def test_forces_at_two_points_balance_what_pushes_the_peg(depth, chamfer):
    """Without friction, by Newton and Euler for a peg that slides along its axis.

    The side pushes at the end along x, the rim perpendicular to the axis, and the peg accelerates.
    The last equations are the second derivatives of x_end = -c and x_rim = c at rest.
    """
    plant = plant_of(planar_peg(chamfer))
    state, angle = two_points(depth, chamfer, CLEARANCE)
    push = np.array([0.7, -0.3, 0.02])
    _, context = simulator_of(plant, state, control=push)
    assert plant.closed(context) == ("wall.side", "wall.rim")
    c, s = np.cos(angle), np.sin(angle)
    lever = ARM - (depth - chamfer) / c  # From the center of mass to the rim, along the axis.
    # Moments about y: positive forces along x at the distance b below the center turn by -b cos.
    equations = np.array(
        [
            [MASS, 0.0, 0.0, -1.0, c],
            [0.0, MASS, 0.0, 0.0, -s],
            [0.0, 0.0, INERTIA, ARM * c, -lever],
            [1.0, 0.0, -ARM * c, 0.0, 0.0],
            [-c, s, lever, 0.0, 0.0],
        ]
    )
    free = push - [0.0, MASS * GRAVITY, 0.0]
    *_, side, rim = np.linalg.solve(equations, [*free, 0.0, 0.0])
    assert min(side, rim) > 0.0
    wanted = [0.0, side, rim] if chamfer else [side, rim]
    # The gap is 2e-4 of 1e-2 m, found to 1e-12: the lever is off by 1e-10 of itself.
    assert_allclose(value(plant, context, "hole_force"), wanted, rtol=1e-8)


@pytest.mark.slow
def test_a_rattling_peg_keeps_its_energy_without_friction():
    """It bounces between the sides of its hole with e = 1; between impacts its motion is exact."""
    plant = plant_of(planar_peg(gravity=0.0, driven=False), restitution=1.0)
    state = standing(0.0, -0.012, 0.0)
    state[3:] = [0.01, 0.01, 0.4]
    simulator, context = simulator_of(plant, state, 1e-3, 1e-6)
    simulator.AdvanceTo(0.035)
    events = plant.events(context)
    assert {name for event in events for name in event.contacts} == {"wall.side", "wall.rim"}
    assert len(events) >= 4
    masses = np.array([MASS, MASS, INERTIA])
    kept = masses @ plant.state(context)[3:] ** 2
    assert_allclose(kept, masses @ state[3:] ** 2, rtol=1e-12)
    assert value(plant, context, "hole_gap")[1:].min() > -1e-11


def test_around_the_side_of_its_hole_a_peg_needs_the_centripetal_force():
    """A peg that does not turn slides around in its hole: M v^2 / c, side and rim together."""
    plant, speed = plant_of(upright_peg()), 0.01
    simulator, context = simulator_of(plant, [CLEARANCE, 0.0, -5e-3, 0.0, speed, 0.0], 1e-4, 1e-9)
    simulator.AdvanceTo(0.05)
    x, y, z, *velocity = plant.state(context)
    turned = speed * 0.05 / CLEARANCE
    # Steps of 1e-4 s turn it by 0.01 rad: runge_kutta5 is off by 1e-12 rad in each of 500 steps.
    assert_allclose([x, y], CLEARANCE * np.array([np.cos(turned), np.sin(turned)]), atol=1e-12)
    assert_allclose(np.linalg.norm(velocity), speed, rtol=1e-9)
    assert_allclose(
        value(plant, context, "hole_force").sum(), MASS * speed**2 / CLEARANCE, rtol=1e-8
    )
    assert z == -5e-3


def test_a_hole_that_moves_holds_its_peg_back():
    """The plate is at A sin(w t + 1/2); the peg begins with its speed, and needs M A w^2 sin."""
    plant = plant_of(upright_peg(exogenous=["wall.position"]))
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    moved = [SinusoidReference(0.0, 0.01, 5.0, 0.5), ConstantReference([0.0, 0.0])]
    table = builder.AddSystem(ReferenceGenerator(moved, plant.exogenous_layout.degrees))
    builder.Connect(table.get_output_port(), plant.GetInputPort("exogenous"))
    simulator, root, context = in_equal_steps(builder, plant, "runge_kutta5", 0.01)
    at, speed = 0.01 * np.sin(0.5), 0.05 * np.cos(0.5)
    plant.set_state(context, [CLEARANCE + at, 0.0, -5e-3, speed, 0.0, 0.0])
    root.SetAccuracy(1e-9)
    simulator.AdvanceTo(0.2)
    moved = 0.01 * np.sin(5.0 * 0.2 + 0.5)
    # The steps of 0.01 s are off by (w h)^6 = 2e-8 of the motion, and it is projected.
    assert_allclose(plant.state(context)[0], CLEARANCE + moved, atol=1e-11)
    assert_allclose(value(plant, context, "hole_force").sum(), MASS * 25.0 * moved, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.8, 1.25])
def test_a_peg_jams_where_the_classical_condition_says(ratio):
    """Whitney (1982): under F_z and M about its end a peg jams if |M| / (r F_z) > l / (2 r mu).

    Two points at a distance l have the forces M / l each without a force across, and together a
    friction of 2 mu M / l. Below the limit the rest accelerates the peg. Above it regularized
    friction lets it creep at the share s = F_z l / (2 mu M) of its friction, v = v_s s / sqrt(1 -
    s^2). This is for small angles: here 2 c / l = 0.00017.
    """
    mu, creep, load, depth, clearance = 0.2, 1e-5, 5.0, 0.012, 1e-6
    model = planar_peg(0.0, gravity=0.0, friction=mu, stiction_tolerance=creep)
    plant = plant_of(model, clearance=clearance)
    state, _ = two_points(depth, 0.0, clearance)
    moment = ratio * load * depth / (2.0 * mu)
    push = np.array([0.0, -load, moment])
    simulator, context = simulator_of(plant, state, 1e-5, 1e-9, control=push)
    simulator.AdvanceTo(0.002)
    speed = -plant.state(context)[4]
    assert_allclose(value(plant, context, "hole_force"), moment / depth, rtol=2e-3)
    if ratio < 1.0:
        simulator.AdvanceTo(0.004)
        gained = -plant.state(context)[4] - speed
        assert_allclose(gained, (load - 2.0 * mu * moment / depth) / MASS * 0.002, rtol=1e-2)
    else:
        share = 1.0 / ratio
        assert_allclose(speed, creep * share / np.sqrt(1.0 - share**2), rtol=5e-3)


@pytest.mark.parametrize(
    ("peg", "message"),
    [
        (Peg("floor", 0.004, 0.02), "contact that opens"),
        (
            Peg("wall", 0.005, 0.02),
            "leaves no clearance in the hole of 'wall', whose radius is 0.005",
        ),
        (peg_of(CLEARANCE), "'wall' has two pegs"),
    ],
)
def test_a_peg_that_does_not_fit_is_refused(peg, message):
    pegs = [peg_of(CLEARANCE), peg] if "two" in message else [peg]
    with pytest.raises(ModelError, match=message):
        UnilateralRobotPlant(planar_peg(), {"wall": 0.0}, pegs=pegs)


def test_a_peg_needs_a_hole_and_the_friction_of_its_sides():
    model = planar_peg(friction=0.3, viscous_friction=1.0)
    with pytest.raises(ModelError, match="viscous friction"):
        plant_of(model)
    plane = PointOnSurface("peg", Plane((0, 0, 0), (0, 0, 1)), (0.0, 0.0, -ARM), "wall")
    with pytest.raises(ModelError, match="'wall' has no hole"):
        plant_of(RobotModel(model.links, [plane], [], forces=[]))


def free_peg():
    """A peg in space, with roll, pitch and yaw."""
    plant = MultibodyPlant(0.0)
    body = plant.AddRigidBody("peg", SpatialInertia.SolidBoxWithMass(2.0, 0.1, 0.1, 0.1))
    plant.AddJoint(RpyFloatingJoint("free", plant.world_frame(), body.body_frame()))
    plant.Finalize()
    return MultibodyExpressions(plant)


@pytest.mark.parametrize("seed", range(4))
def test_gaps_are_distances_between_the_skin_of_the_peg_and_the_body_of_the_plate(seed):
    """`Plate.clearance` of the whole hole, least over circles of the peg parallel to the face.

    To first order in gaps of up to 0.05 mm; the skin has circles of 720 points, so that
    its least distance is off by less than 0.1 micrometers.
    """
    random = np.random.default_rng(seed)
    clearance = 1e-4
    links, rpy = free_peg(), random.uniform(-0.5, 0.5, 3)
    wall = PointOnSurface("peg", plate_of(CHAMFER), (0.0, 0.0, -ARM), "wall", tuple(rpy))
    model = RobotModel(links, [wall], [], forces=[])
    made = peg_in_hole(wall, peg_of(clearance), model)
    gaps = ca.vertcat(*(opening.gap for opening in made.openings))
    edges = ca.vertcat(*(ca.mmin(opening.edges) for opening in made.openings))
    slopes = ca.jacobian(gaps, links.q[3:])
    inputs = {"q": links.q, "p": model.dae.parameter_symbol}
    function = TracedFunction("gaps", inputs, {"gap": gaps, "edges": edges, "slope": slopes})
    point = ca.SX.sym("point", 3)
    body = ca.Function("body", [point], [wall.surface.clearance(point)])
    turned, seen = RollPitchYaw(rpy).ToRotationMatrix(), set()
    for _ in range(40):
        # In the axes of the plate: the end of the peg and the direction from it.
        below = random.choice([random.uniform(2e-4, 9e-4), random.uniform(4e-3, 1e-2)])
        way, tilt = random.uniform(0.0, 2.0 * np.pi, 2)
        lean = random.uniform(0.0, 0.01)
        up = np.array([np.sin(lean) * np.cos(tilt), np.sin(lean) * np.sin(tilt), np.cos(lean)])
        reach = clearance + max(CHAMFER - below, 0.0) - random.uniform(0.0, 5e-5)
        tip = np.array([reach * np.cos(way), reach * np.sin(way), -below])
        # Its frame: its z axis is `up`.
        across = np.cross([0.0, 1.0, 0.0], up)
        across /= np.linalg.norm(across)
        axes = turned @ RotationMatrix(np.column_stack([across, np.cross(up, across), up]))
        place = turned @ tip - axes @ np.array([0.0, 0.0, -ARM])
        q = np.concatenate([RollPitchYaw(axes).vector(), place])
        found, on, slope = function(q, model.dae.parameter_values)
        least = min((gap, i) for i, gap in enumerate(found) if on[i] > 0.0)
        angles, heights = np.linspace(0.0, 2.0 * np.pi, 721)[:-1], np.linspace(0.0, 0.012, 2001)
        circle = (HOLE - clearance) * np.column_stack(
            [np.cos(angles), np.sin(angles), 0.0 * angles]
        )
        middle = tip + heights[:, None] * up / up[2]
        # Only the circles where they may touch: at the end, and at the rim.
        near = [0, *np.argsort(np.abs(middle[:, 2] + CHAMFER))[:2]]
        skin = (middle[near, None] + circle[None]).reshape(-1, 3)
        distance = np.min(np.array(body(skin.T)))
        if 0.0 < least[0] < 5e-5:  # Outside of the plate its distance is that of its nearest point.
            assert_allclose(least[0], distance, rtol=0.0, atol=1e-6)
            seen.add(least[1])
            normal = slope.reshape(len(found), 3)[least[1]]
            assert_allclose(np.linalg.norm(normal), 1.0, rtol=1e-9)
    assert seen == {0, 1, 2}
