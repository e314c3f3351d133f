"""The forces of a tool that is searched for, and inserted into, a hole, before the task runs."""

from dataclasses import dataclass
from math import cos, degrees, pi

import casadi as ca
import numpy as np
from scipy.special import lambertw

from drake_dae.arrays import FloatArray
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.robots.constraint_wrenches import own_values
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice.advice import least_damping
from drake_dae.scenario.advice.touch import reaction_time, touch_peak
from drake_dae.scenario.controllers.task_controller import opening_contact
from drake_dae.scenario.feasibility.touches import angle_between, normals_at, plant_values
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.plants.contact.contact_material import Peg
from drake_dae.systems.task.contacts.laws import FREE
from drake_dae.systems.task.controller import TaskController
from drake_dae.systems.task.phases import Insert, Press, Search

_SIDES = 24
"""The number of sides of the polygons around the circles within which a hole moves a tool."""

_RIGID = 1e-9
"""The mobility of a direction in which a robot cannot move its tool, relative to another one; and
the share of damping in a fall that is free."""

_HITTING = 2
"""The number of balls of a peg that hit the rim or the side of a hole together."""


@dataclass(frozen=True)
class StandingForce:
    """The largest net force on a tool that stands still in a hole, in N, and what it is for.

    Attributes:
        force: The force, in N.
        lag: The largest lag along the hole, in m.
        aside: The largest way aside of the tool from where its outputs rest, in m.
        tilt: The largest angle between the axis of the tool and where its outputs rest, in rad; 0
            for a ball.
    """

    force: float
    lag: float
    aside: float
    tilt: float

    def __str__(self) -> str:
        tilted = f" and tilted by {degrees(self.tilt):.2g} degrees" if self.tilt else ""
        return (
            f"a tool that stands still in the hole, jammed or not, presses with {self.force:.3g} N "
            f"at most, {self.lag:.2g} m behind, {self.aside:.2g} m aside{tilted}"
        )


@dataclass(frozen=True)
class HoleForce:
    """The largest forces of a `Search` for a hole, or of an `Insert`.

    Attributes:
        phase: Its name.
        speed: The speed at which it hits the rim or the side, in m/s.
        mass: The mass of the tool in this direction, in kg.
        fall: The speed at which it has fallen by the depth of a Search, in m/s; 0 of an Insert.
        hit: The largest force that is expected of these hits, in N. It is an estimate: the tool may
            hit in another direction, and friction adds to it.
        standing: See `StandingForce`; None for a Search, or where it is not known.
    """

    phase: str
    speed: float
    mass: float
    fall: float
    hit: float
    standing: StandingForce | None = None

    @property
    def peak(self) -> float:
        """The larger one of both forces, in N."""
        return max(self.hit, 0.0 if self.standing is None else self.standing.force)

    def __str__(self) -> str:
        falls = f", or fall into it with {self.fall:.2g} m/s" if self.fall else ""
        text = (
            f"{self.phase} may hit the hole with {self.speed:.3g} m/s and {self.mass:.3g} kg"
            f"{falls}: at most {self.hit:.3g} N are expected"
        )
        return text if self.standing is None else f"{text}; {self.standing}"


def hole_forces(
    scenario: Scenario, model: RobotModel, controller: TaskController, state: FloatArray
) -> tuple[HoleForce, ...]:
    """The largest forces of each `Search` and `Insert` of a task at a hole in its surface.

    A hit is that of `touch_peak`, with two balls of a peg. A Search that is pressed with F also
    falls: by x'' = F / m - c x', with the law's damping c of the constraint, it has a speed w after
    its depth, and one ball stops it with F + w sqrt(K m). For a tool that stands still the law
    without contact has

        A_0 e + A_1 e' = P M^-1 J^T f,    J P^-1 e = xi,    e' = v,

    with the gains A_0 and A_1, the Jacobian P of its outputs, and that of the place and the axis of
    the tool, J. The speed v is that of the reference of the distance, and xi is how far the hole
    holds the tool from where its outputs rest: behind by at most `lag`, aside, and tilted. So

        f = C^-1 (xi + b v),    C = J P^-1 A_0^-1 P M^-1 J^T,    b = J P^-1 A_0^-1 A_1,

    is the sum of all forces at the tool, by the law's model, whatever the friction is and however
    many points touch; forces that jam the tool between two sides cancel in it. The moment about the
    axis of the tool, of friction alone, is left out.

    Aside is the chamfer and the clearance, where a Search has found the hole, and the way in which
    it comes to rest; without a Search the distance of the hole from where the law has it. The tilt
    is that of the hole in `plant_parameters`, with 2 c / depth for a clearance c.

    Args:
        scenario: The completed scenario.
        model: Its robot.
        controller: Its task.
        state: x, near which it is inserted.
    """
    material, points = scenario.plant.material, opening_contact(scenario, model)
    if material is None or len(points) != 1 or points[0].opening is None:
        return ()
    (contact,), (radius, chamfer) = points, points[0].opening
    peg = next((peg for peg in material.pegs if peg.constraint == contact.name), None)
    late = reaction_time(scenario.sampling, material.time_step)
    tool = _tool(scenario, model, controller.pairs[0].laws[FREE], contact, peg, state)
    given = scenario.constraint_damping
    damping = 0.0 if given is None else least_damping(controller.law.structure, given)
    stiffness = material.stiffness * (1 if peg is None else _HITTING)
    clearance = max(radius - (material.radius if peg is None else peg.radius), 0.0)
    pressed, speed, aside, found = 0.0, 0.0, tool.offset, list[HoleForce]()
    for phase in controller.task.plan.phases:
        if isinstance(phase, Press):
            force = phase.needed(controller.task.contact_force).get("force", 0.0)
            pressed = force + phase.tolerance
        elif isinstance(phase, Search):
            mass = tool.mass_across
            hit = touch_peak(pressed, phase.speed, stiffness, 1.0 / mass, late)
            fall = fall_speed(pressed / tool.mass, damping, phase.depth)
            landing = touch_peak(pressed, fall, material.stiffness, 1.0 / tool.mass, 0.0)
            found.append(HoleForce(phase.name, phase.speed, mass, fall, max(hit, landing)))
            aside, speed = chamfer, phase.speed
        elif isinstance(phase, Insert):
            hit = touch_peak(0.0, phase.speed, stiffness, 1.0 / tool.mass, late)
            way = aside + clearance + speed * phase.over / 2.0 + tool.tilt * phase.depth
            tilt = 0.0 if peg is None else tool.tilt + 2.0 * clearance / phase.depth
            standing = tool.standing(phase, way, tilt) if tool.can_stand else None
            found.append(HoleForce(phase.name, phase.speed, tool.mass, 0.0, hit, standing))
    return tuple(found)


def misfit(scenario: Scenario, model: RobotModel) -> str:
    """A sentence if a task enters a hole for which its tool is too thick on contact that gives way.

    Args:
        scenario: The completed scenario.
        model: Its robot.
    """
    material, task = scenario.plant.material, scenario.task
    entering = [] if task is None else [each.name for each in task.phases if each.enters_holes]
    if material is None or not entering:
        return ""
    points = opening_contact(scenario, model)
    if len(points) != 1 or points[0].opening is None:
        return ""
    (contact,), (radius, _) = points, points[0].opening
    own, tool = material.radius, "the ball at the tool (plant.radius)"
    for peg in material.pegs:
        if peg.constraint == contact.name:
            own, tool = peg.radius, "the peg (plant.pegs)"
    if own < radius:
        return ""
    return (
        f"{entering[0]} cannot enter the hole of '{contact.name}': its radius is {radius:g} m, and "
        f"that of {tool} is {own:g} m"
    )


def fall_speed(push: float, damping: float, depth: float) -> float:
    """The speed of x'' = a - c x' from rest, in m/s, where x is the depth.

    With s = c t it is (a / c) (1 - exp(-s)), where s - 1 + exp(-s) = c^2 depth / a.

    Args:
        push: a, in m/s^2.
        damping: c, in 1/s.
        depth: In m.
    """
    if damping**2 * depth <= _RIGID * push:
        return float(np.sqrt(2.0 * push * depth))
    way = damping**2 * depth / push + 1.0
    after = way + lambertw(-np.exp(-way)).real
    return float(push / damping * -np.expm1(-after))


@dataclass(frozen=True, eq=False)
class ToolAtHole:
    """A tool at a hole, in one state.

    Attributes:
        jacobian: J, of its place along the normal and across it, and of its axis across, shape
            (5, nv), or (3, nv) for a ball.
        moved: M^-1 J^T.
        outputs: P, shape (p, nv).
        stiff, damped: A_0, shape (p, p), and the column of A_1 for the distance; empty for a law
            with outputs of another degree than 2.
        offset, tilt: How far the hole of the plant is aside of the model's, in m, and its angle to
            it, in rad.
    """

    jacobian: FloatArray
    moved: FloatArray
    outputs: FloatArray
    stiff: FloatArray
    damped: FloatArray
    offset: float
    tilt: float

    @property
    def mass(self) -> float:
        """Its mass along the hole, in kg."""
        return float(1.0 / (self.jacobian[0] @ self.moved[:, 0]))

    @property
    def mass_across(self) -> float:
        """Its largest mass along the surface, in kg, in directions in which the robot moves it."""
        mobility = np.linalg.eigvalsh(self.jacobian[1:3] @ self.moved[:, 1:3])
        return float(1.0 / np.min(mobility[mobility > _RIGID * mobility[-1]]))

    @property
    def can_stand(self) -> bool:
        """Whether f is known: the robot can move the tool in each way in which a hole holds it."""
        count, rows = len(self.jacobian), len(self.stiff)
        square = self.stiff.shape == self.outputs.shape == (rows, rows) and rows > 0
        return square and np.linalg.matrix_rank(self.jacobian @ self.moved) == count

    def standing(self, phase: Insert, aside: float, tilt: float) -> StandingForce:
        """The largest |f| of its first three components; see `hole_forces`.

        Args:
            phase: The phase.
            aside, tilt: The largest ways in m and in rad.
        """
        to_tool = self.jacobian @ np.linalg.inv(self.outputs)
        compliance = to_tool @ np.linalg.solve(self.stiff, self.outputs @ self.moved)
        ahead = to_tool @ np.linalg.solve(self.stiff, self.damped) * phase.speed
        forces = np.linalg.inv(compliance)[:3]
        # A polygon around the circle: |f| is convex, and largest at a corner.
        turns = 2.0 * pi * np.arange(_SIDES) / _SIDES
        corners = np.array([np.cos(turns), np.sin(turns)]) / cos(pi / _SIDES)
        along = forces[:, :1] * np.array([0.0, phase.lag]) + (forces @ ahead)[:, None]
        every = along[:, :, None] + (forces[:, 1:3] @ corners * aside)[:, None, :]
        if len(self.jacobian) > 3:
            every = every[..., None] + (forces[:, 3:] @ corners * tilt)[:, None, None, :]
        largest = float(np.linalg.norm(every, axis=0).max())
        return StandingForce(largest, phase.lag, aside, tilt)


def _tool(
    scenario: Scenario,
    model: RobotModel,
    law: TrackingLaw,
    contact: Constraint,
    peg: Peg | None,
    state: FloatArray,
) -> ToolAtHole:
    links, dae = model.links, model.dae
    touch = contact.touch(links)
    assert touch is not None
    values, changed = dae.parameter_values, plant_values(scenario, model, contact)
    n, turned = normals_at(scenario, model, contact, state)
    across = np.linalg.svd(n[None])[2][1:]
    here, there = (
        contact.placement(own_values(contact, dae, own)).translation() for own in (values, changed)
    )
    rows = ca.mtimes(ca.DM(np.vstack([n, across])), links.position(touch.frame, touch.point))
    if peg is not None:
        axis = ca.mtimes(links.rotation(touch.frame), ca.DM(peg.axis))
        rows = ca.vertcat(rows, ca.mtimes(ca.DM(across), axis))
    terms = dae.trace("tool", {"jacobian": _rates(model, rows), "mass": links.mass_matrix})
    jacobian, mass = terms(state, values)
    chains = ca.vertcat(*(chain[0] for chain in law.structure.output_chains))
    outputs = law.system.trace("outputs", {"jacobian": _rates(model, chains)})
    stiff: FloatArray = np.zeros((0, 0))
    damped: FloatArray = np.zeros(0)
    if set(law.degrees) == {2}:
        names = [signal.name for signal in law.system.output_signals]
        distance = names.index(contact.residual_signals[0].name)
        stiff, damped = law.gains.matrix[:, 0::2], law.gains.matrix[:, 2 * distance + 1]
    moved = np.linalg.solve(mass, jacobian.T).astype(np.float64)
    return ToolAtHole(
        jacobian,
        moved,
        outputs(state, law.system.parameter_values)[0],
        stiff,
        damped,
        float(np.linalg.norm(across @ (there - here))),
        angle_between(n, turned),
    )


def _rates(model: RobotModel, rows: ca.SX) -> ca.SX:
    """The Jacobian of rows by the velocities."""
    return ca.mtimes(ca.jacobian(rows, model.links.q), model.links.velocity_map)
