"""Random trees of links that touch, hold and are driven by everything that the library has."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
from campaign.outcomes import Outcome, checked
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    LinearSpringDamper,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RpyFloatingJoint,
)
from pydrake.systems.analysis import SimulatorConfig
from random_plants import random_inertia, random_pose

from drake_dae import (
    AxisCoordinates,
    CoincidentPoints,
    ConstantReference,
    Cylinder,
    DcMotors,
    ElectrohydraulicServos,
    Ellipsoid,
    FlexibleJoints,
    ImplicitSurface,
    JointPositions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    Sphere,
    SurfaceCoordinates,
    Torus,
    TrackingLaw,
    WeldedFrames,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.dae import find_structure
from drake_dae.robots import Constraint, MultibodyExpressions, PositionOutput, Stage, Surface

Random = np.random.Generator

DURATION, STEP = 0.2, 1e-3

CHAINS = ("rigid", "flexible", "motors", "hydraulics", "flexible motors")
SURFACES = ("plane", "sphere", "cylinder", "ellipsoid", "torus", "implicit")
BINDINGS = ("nothing", "surface", "two surfaces", "pin", "loop", "weld", "welded branches")


class Tree(NamedTuple):
    """Links: the finalized plant, a random q, and the tips of branches, the longest one first."""

    plant: MultibodyPlant
    positions: np.ndarray
    tips: list[str]


@dataclass
class Plan:
    """What a seed chose: one of CHAINS and of BINDINGS, 2 to 7 joints, a base that floats without
    gravity, a first joint that has no actuator but a spring; and what surfaces there are."""

    stage: str
    binding: str
    joints: int
    floating: bool
    passive: bool
    surfaces: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        marks = ["floating"] * self.floating + ["a passive joint"] * self.passive
        parts = [f"{self.joints} joints", self.binding, *self.surfaces, self.stage, *marks]
        return ", ".join(parts)


def attempt(seed: int, folder: Path) -> Outcome:
    """Makes, checks and runs a random robot."""
    random = np.random.default_rng(seed)
    plan = _plan(random)
    with checked("") as outcome:
        tree = _tree(random, plan)
        links = MultibodyExpressions(tree.plant)
        constraints = _constraints(random, plan, tree)
        outcome.what = str(plan)
        outputs = _outputs(random, links, constraints, tree)
        model = RobotModel(
            links, constraints, outputs, tree.positions, "random", _stages(random, plan)
        )
        structure = find_structure(model.dae)
        law = TrackingLaw(model.dae, poles(-random.uniform(3.0, 8.0)), structure=structure)
        goals = _goals(random, model, links, tree)
        references = [_reference(random, goal) for goal in goals]
        plant = RobotPlant(model, structure=structure)
        loop = make_closed_loop(plant, law, references)
        context = loop.diagram.CreateDefaultContext()
        wanted = law.layout.values(loop.reference.reference(0.0))
        count = len(model.position_signals)
        wanted[:count] += random.uniform(-0.02, 0.02, count)
        configuration = model.configuration(wanted[:count], tree.positions)
        own = loop.plant.GetMyMutableContextFromRoot(context)
        loop.plant.set_consistent_state(own, model.rest_state(configuration, wanted[count:]))
        config = SimulatorConfig(
            integration_scheme="runge_kutta5", max_step_size=STEP, use_error_control=False
        )
        simulate(loop.diagram, context, DURATION, config)
        record = loop.record(context)
        outcome.figures(record, loop.predicted_error(record))
    outcome.what = str(plan)
    return outcome


def _plan(random: Random) -> Plan:
    stage = str(random.choice(CHAINS, p=(0.4, 0.15, 0.15, 0.15, 0.15)))
    binding = str(random.choice(BINDINGS, p=(0.1, 0.35, 0.15, 0.1, 0.1, 0.1, 0.1)))
    # Springs and motors differentiate the rigid robot's equations once or twice more.
    most = 7 if stage == "rigid" else 5 if stage in ("hydraulics", "motors") else 4
    joints = int(random.integers(2, most + 1))
    if binding == "weld":
        joints, stage = int(random.integers(6, 8)), "rigid"
    if binding == "welded branches":
        joints, stage = 7, "rigid"
    floating = bool(stage == "rigid" and joints <= 4 and random.random() < 0.25)
    passive = bool(not floating and random.random() < 0.1)
    return Plan(stage, binding, joints, floating, passive)


def _tree(random: Random, plan: Plan) -> Tree:
    """A plant with joints in random directions, dampers, springs and gravity or none."""
    branched = plan.binding in ("loop", "welded branches") or random.random() < 0.3
    parents = []
    for index in range(plan.joints):
        chain = index - 1
        if branched and plan.binding in ("loop", "welded branches"):
            # Two branches from the base, so that their ends can meet.
            chain = index - 2 if index > 1 else -1
        elif branched and index > 1:
            chain = int(random.integers(-1, index))
        parents.append(chain)
    plant = MultibodyPlant(0.0)
    base = plant.world_body()
    if plan.floating:
        base = plant.AddRigidBody("base", random_inertia(random))
        plant.AddJoint(RpyFloatingJoint("base", plant.world_frame(), base.body_frame()))
    bodies = []
    for index, parent in enumerate(parents):
        above = bodies[parent] if parent >= 0 else base
        bodies.append(plant.AddRigidBody(f"link{index}", random_inertia(random)))
        own = bodies[-1].body_frame()
        place = FixedOffsetFrame(f"place{index}", above.body_frame(), random_pose(random))
        make = RevoluteJoint if random.random() < 0.75 else PrismaticJoint
        damping = random.uniform(0.0, 0.5) * (random.random() < 0.5)
        ends = plant.AddFrame(place), own, _direction(random)
        joint = plant.AddJoint(make(f"joint{index}", *ends, damping=damping))
        plant.AddFrame(FixedOffsetFrame(f"tip{index}", own, random_pose(random)))
        if index or not plan.passive:
            motor = plant.AddJointActuator(f"motor{index}", joint)
            motor.set_default_rotor_inertia(random.uniform(1e-4, 1e-3))
            motor.set_default_gear_ratio(30.0)
    _add_springs(random, plan, plant)
    if plan.floating or random.random() < 0.2:
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    plant.Finalize()
    depth = [0] * plan.joints
    for index, parent in enumerate(parents):
        depth[index] = 1 + (depth[parent] if parent >= 0 else 0)
    ends = [index for index in range(plan.joints) if index not in parents]
    ends.sort(key=lambda index: -depth[index])
    positions = random.uniform(-1.2, 1.2, plant.num_positions())
    return Tree(plant, positions, [f"tip{index}" for index in ends])


def _add_springs(random: Random, plan: Plan, plant: MultibodyPlant) -> None:
    for index in range(plan.joints):
        if (plan.passive and index == 0) or random.random() < 0.15:
            joint = plant.GetJointByName(f"joint{index}")
            spring = RevoluteSpring if joint.type_name() == "revolute" else PrismaticSpring
            plant.AddForceElement(spring(joint, random.uniform(-0.5, 0.5), random.uniform(20, 80)))
    if random.random() < 0.15:
        a, b = (plant.GetBodyByName(name) for name in ("link0", "link1"))
        plant.AddForceElement(
            LinearSpringDamper(a, [0, 0, 0.9], b, [0, 0.9, 0], 0.4, random.uniform(5, 50), 0.5)
        )


def _constraints(random: Random, plan: Plan, tree: Tree) -> list[Constraint]:
    """What holds the tree where it is."""
    plant, tips = tree.plant, tree.tips
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, tree.positions)
    poses = {tip: plant.GetFrameByName(tip).CalcPoseInWorld(context) for tip in tips}
    if plan.binding == "nothing":
        return []
    if plan.binding in ("surface", "two surfaces"):
        count = 1 if plan.binding == "surface" else 2
        made: list[Constraint] = []
        for index in range(count):
            tip, point = tips[index % len(tips)], random.uniform(-0.2, 0.2, 3)
            kind = str(random.choice(SURFACES))
            plan.surfaces.append(kind)
            surface = _surface(random, kind, poses[tip] @ point)
            made.append(PointOnSurface(tip, surface, tuple(point), f"surface{index}"))
        return made
    # Two branches meet, or one of them is held by the world.
    meet = plan.binding in ("loop", "welded branches") and len(tips) > 1
    a, b = (tips[0], tips[1]) if meet else ("world", tips[0])
    between = poses[a].InvertAndCompose(poses[b]) if meet else poses[b]
    if plan.binding in ("weld", "welded branches"):
        return [WeldedFrames(a, b, between)]
    axes = str(random.choice(["x", "yz", "xyz"])) if plan.joints > 2 else "y"
    return [CoincidentPoints(a, tuple(between.translation()), b, (0, 0, 0), axes)]


def _surface(random: Random, kind: str, point: np.ndarray) -> Surface:
    """A surface through a point."""
    normal, inside = _direction(random), bool(random.random() < 0.3)
    size, axis = random.uniform(0.2, 0.8), _direction(random)
    if kind == "plane":
        return Plane(tuple(point), tuple(normal))
    if kind == "sphere":
        # Its coordinates are singular at the poles.
        return Sphere(tuple(point - size * normal), size, tuple(axis), inside)
    if kind == "cylinder":
        across = np.cross(axis, normal)
        radial = np.cross(across, axis) / np.linalg.norm(across)
        return Cylinder(tuple(point - size * radial), tuple(axis), size, inside)
    if kind == "implicit":
        # A paraboloid that is as steep as the normal says; it has a slope everywhere.
        bend, sloped = random.uniform(-1.0, 1.0), ca.DM(normal)
        return ImplicitSurface(lambda p: ca.dot(sloped, p) + bend * ca.sumsqr(p), tuple(point))
    if kind == "ellipsoid":
        semi_axes = size * random.uniform(0.5, 1.5, 3)
        return Ellipsoid(tuple(point - semi_axes * normal), tuple(semi_axes), inside)
    across = np.cross(axis, normal)
    radial = np.cross(across, axis) / np.linalg.norm(across)
    minor, angle = 0.4 * size, random.uniform(-3.0, 3.0)
    center = point - (size + minor * np.cos(angle)) * radial - minor * np.sin(angle) * axis
    return Torus(tuple(center), tuple(axis), size, minor, inside)


def _stages(random: Random, plan: Plan) -> list[Stage]:
    # With a damper the springs' rate, stiffness / damping, is part of the zero dynamics: the step
    # must resolve it.
    damping = random.uniform(5.0, 20.0) if random.random() < 0.5 else 0.0
    flexible = FlexibleJoints(random.uniform(500.0, 5000.0), random.uniform(0.1, 1.0), damping)
    motors = DcMotors(
        random.uniform(0.1, 1.0), random.uniform(0.005, 0.05), random.uniform(0.5, 2.0), 20.0
    )
    hydraulics = ElectrohydraulicServos(
        10 ** random.uniform(4, 6), 10 ** random.uniform(-7, -5), random.uniform(0.02, 0.1)
    )
    return {
        "rigid": [],
        "flexible": [flexible],
        "motors": [motors],
        "hydraulics": [hydraulics],
        "flexible motors": [flexible, motors],
    }[plan.stage]


def _outputs(
    random: Random, links: MultibodyExpressions, constraints: list[Constraint], tree: Tree
) -> list[PositionOutput]:
    """As many as there are actuators left, each independent of the others where the tree is."""
    own = [parameter for constraint in constraints for parameter in constraint.parameters]
    symbols = ca.vertcat(ca.SX(0, 1), *[parameter.symbol for parameter in own])
    values = ca.vertcat(ca.DM(0, 1), *[parameter.value for parameter in own])

    def fixed(rows: ca.SX) -> ca.SX:
        return ca.substitute(rows, symbols, ca.SX(values))

    held = [fixed(constraint.residual(links)) for constraint in constraints]
    missing = len(links.actuator_signals) - sum(rows.numel() for rows in held)
    driven = {signal.name.replace("motor", "joint") for signal in links.actuator_signals}
    candidates: list[PositionOutput] = [
        JointPositions([signal.name]) for signal in links.position_signals if signal.name in driven
    ]
    tip = tree.tips[0]
    candidates += [PointCoordinates(tip, axis) for axis in "xyz"]
    candidates += [AxisCoordinates(tip, "z", component) for component in "xy"]
    random.shuffle(candidates)  # type: ignore[arg-type]
    surfaces = [each for each in constraints if each.coordinate_signals]
    if surfaces and missing >= 2 and random.random() < 0.4:
        candidates.insert(0, SurfaceCoordinates(surfaces[0]))
    slopes, chosen = _slope(links, held, tree), []
    for candidate in candidates:
        expression = candidate.expression(links)
        if expression.numel() > missing:
            continue
        more = np.vstack([slopes, _slope(links, [fixed(expression)], tree)])
        if np.linalg.svd(more, compute_uv=False)[-1] > 0.05:
            slopes, missing = more, missing - expression.numel()
            chosen.append(candidate)
    return chosen


def _slope(links: MultibodyExpressions, rows: list[ca.SX], tree: Tree) -> np.ndarray:
    """The derivatives of rows with respect to q where the tree is, shape (k, nq)."""
    return _value(ca.jacobian(ca.vertcat(ca.SX(0, 1), *rows), links.q), links, tree)


def _value(expression: ca.SX, links: MultibodyExpressions, tree: Tree) -> np.ndarray:
    return np.array(ca.Function("value", [links.q], [expression])(tree.positions))


def _goals(
    random: Random, model: RobotModel, links: MultibodyExpressions, tree: Tree
) -> np.ndarray:
    """Where the outputs are now, and random forces."""
    rows = [output.expression(links) for output in model.outputs]
    known = {parameter.name: parameter for parameter in model.dae.parameters}
    symbols = ca.vertcat(*[parameter.symbol for parameter in known.values()])
    values = ca.DM(model.dae.parameter_values)
    expression = ca.substitute(ca.vertcat(ca.SX(0, 1), *rows), symbols, values)
    forces = random.uniform(5.0, 20.0, model.dae.num_constraints)
    return np.concatenate([_value(expression, links, tree).reshape(-1), forces])


def _reference(random: Random, goal: float) -> ConstantReference | SinusoidReference:
    if random.random() < 0.5:
        return ConstantReference([goal])
    size = 0.1 if abs(goal) < 3.0 else 1.0
    return SinusoidReference(goal, [random.uniform(0.0, size)], [random.uniform(0.5, 3.0)])


def _direction(random: Random) -> np.ndarray:
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)
