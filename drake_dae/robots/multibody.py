"""The equations of motion of a MultibodyPlant as CasADi expressions."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    ForceElementIndex,
    Frame,
    Joint,
    LinearSpringDamper,
    MultibodyForces,
    PrismaticSpring,
    RevoluteSpring,
    UniformGravityFieldElement,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.dae import Parameter, Signal
from drake_dae.dae.signals import LARGEST
from drake_dae.errors import ModelError
from drake_dae.robots.links import ORIGIN, Application, Kinematics, Links, Reaction, position_index
from drake_dae.robots.plant_frames import (
    constant_pose,
    elementary_joints,
    frame_name,
    frame_named,
    joint_velocity_map,
    outlines_of,
    position_of,
    read_links,
    unique_names,
    without_round_off,
)
from drake_dae.robots.tree import (
    Inertia,
    LinkMotion,
    frame_jacobian,
    inverse_dynamics,
    link_motions,
    link_poses,
    mass_matrix,
)
from drake_dae.trace.expressions import length_of
from drake_dae.trace.functions import TracedFunction

TOLERANCE = 1e-10
"""Of a comparison with the plant: round-off gives 1e-14, any modelling error far more."""


@checked(ModelError)
class MultibodyExpressions(Links):
    """The links of a finalized MultibodyPlant; see `Links`:

        M(q) v' + H(q, v) = B u,    q' = N(q) v,

    as CasADi SX expressions in Drake's order, by the algorithms of `tree`. H holds joint damping
    and the springs RevoluteSpring, PrismaticSpring and LinearSpringDamper, M the reflected inertia
    of the rotors. Contact, locked joints, PD controllers of actuators, effort limits, and the
    plant's constraints are not included; `RobotModel` reads these. M, N and H are compared with the
    plant's own values at random states.

    Parameters are the mass in kg of every body, "<body>.mass", with which center of mass and unit
    inertia do not change, and the place of a point mass in m, "<body>.center". Names of q are as
    "joint1" and "base_qx", of v "joint1_w" and "base_wx"; those that several model instances use
    are written "instance::joint1". Without the scene graph, links are their origins.
    """

    def __init__(self, plant: MultibodyPlant, scene_graph: SceneGraph | None = None) -> None:
        if not plant.is_finalized():
            raise ModelError("a finalized MultibodyPlant is needed; call plant.Finalize() first")
        if plant.num_velocities() == 0:
            raise ModelError("the plant has no joint that moves")
        self.plant: MultibodyPlant = plant
        self._bodies = [plant.get_body(BodyIndex(i)) for i in range(plant.num_bodies())]
        self.outlines = outlines_of(plant, scene_graph, self._bodies)
        every = [plant.get_joint(index) for index in plant.GetJointIndices()]
        joints = [joint for joint in every if joint.num_velocities() > 0]
        joints.sort(key=lambda joint: joint.velocity_start())
        self._read_signals(joints)
        self._read_actuators()
        self.position_limits = (plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
        self.velocity_limits = (plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits())
        self.default_positions = plant.GetDefaultPositions()

        self.q = ca.vertcat(*[ca.SX.sym(signal.name) for signal in self.position_signals])
        self.v = ca.vertcat(*[ca.SX.sym(signal.name) for signal in self.velocity_signals])
        self.links, self._places = read_links(plant, self.q)
        self.link_poses = link_poses(self.links)
        self._poses: dict[int, tuple[ca.SX, ca.SX]] = {}
        self.parameters = self._read_masses()
        self.velocity_map = ca.diagcat(*[joint_velocity_map(joint, self.q) for joint in joints])
        self._read_springs(joints)
        self.mass_matrix = mass_matrix(self.links, self._rotors)
        moving = link_motions(self.links, self.v, ca.SX(self.v.numel(), 1), self.gravity)
        inertial = inverse_dynamics(self.links, moving, self.gravity, self.v.numel())
        self.bias = inertial - self._spring_force
        self._compare_with_plant()

    def find(self, frame: str | Frame) -> Frame:
        """A frame of the plant by its name, or "instance::name" if several have that name."""
        resolved = frame_named(self.plant, frame) if isinstance(frame, str) else frame
        if resolved.GetParentPlant() is not self.plant:
            raise ModelError(f"frame '{resolved.name()}' belongs to another plant")
        return resolved

    def on_link(self, frame: Frame) -> tuple[int, FloatArray, FloatArray]:
        """The index of the link that carries a frame; R_LF, shape (3, 3), and p_LF, shape (3,)."""
        link, X_LB = self._places[int(frame.body().index())]
        return link, *constant_pose(X_LB @ frame.GetFixedPoseInBodyFrame())

    def pose(self, frame: Frame) -> tuple[ca.SX, ca.SX]:
        """R_WF, shape (3, 3), and p_WF in m, shape (3, 1)."""
        index = int(frame.index())
        if index not in self._poses:
            link, rotation, offset = self.on_link(frame)
            R_WL, p_WL = self.link_poses[link]
            self._poses[index] = (R_WL @ ca.SX(rotation), p_WL + R_WL @ ca.SX(offset))
        return self._poses[index]

    def rotation(self, frame: str | Frame) -> ca.SX:
        return self.pose(self.find(frame))[0]

    def position(self, frame: str | Frame, point: ArrayLike = ORIGIN) -> ca.SX:
        return position_of(self.pose(self.find(frame)), point)

    def kinematics(self, acceleration: ca.SX | None = None) -> "TreeKinematics":
        if acceleration is None:
            return TreeKinematics(self, *self._moving)
        moving = link_motions(self.links, self.v, acceleration, self.gravity)
        return TreeKinematics(self, acceleration, moving)

    @cached_property
    def _moving(self) -> tuple[ca.SX, list[LinkMotion]]:
        """A symbol for v', and how each link moves with it."""
        acceleration = ca.SX.sym("acceleration", self.v.numel())
        return acceleration, link_motions(self.links, self.v, acceleration, self.gravity)

    def generalized_force(self, kinematics: "TreeKinematics", reaction: Reaction) -> ca.SX:
        result = kinematics.value(reaction.generalized)
        for frame, wrench in reaction.wrenches.items():
            link, (_, origin) = self.on_link(frame)[0], self.pose(frame)
            twist = frame_jacobian(self.links, self.link_poses, link, origin, self.v.numel())
            stacked = ca.sparsify(kinematics.value(ca.vertcat(*wrench)))
            result += ca.mtimes(twist.T, stacked)
        return result

    def inverse_dynamics(self, kinematics: "TreeKinematics", reaction: Reaction) -> ca.SX:
        """M v' + H - tau, with wrenches in the recursion: neither M nor a Jacobian is formed."""
        wrenches: dict[int, tuple[ca.SX, ca.SX]] = {}
        for frame, (pull, turn) in reaction.wrenches.items():
            index, _, lever = self.on_link(frame)
            R_LW = self.link_poses[index][0].T
            force = ca.mtimes(R_LW, kinematics.value(pull))
            moment = ca.mtimes(R_LW, kinematics.value(turn)) + ca.cross(ca.SX(lever), force)
            total = wrenches.get(index, (ca.SX(3, 1), ca.SX(3, 1)))
            wrenches[index] = total[0] + moment, total[1] + force
        force = inverse_dynamics(
            self.links, kinematics.moving, self.gravity, self.v.numel(), wrenches
        )
        force += ca.SX(self._rotors) * kinematics.acceleration - self._spring_force
        return force - kinematics.value(reaction.generalized)  # (37)

    def _read_signals(self, joints: Sequence[Joint]) -> None:
        positions, velocities = [], []
        for joint, name in zip(joints, unique_names(self.plant, joints), strict=True):
            for k in range(joint.num_positions()):
                suffix = joint.position_suffix(k)
                named = f"{name}_{suffix}" if joint.num_positions() > 1 else name
                positions.append(Signal(named, "rad" if suffix[0] == "q" else "m"))
            for suffix in map(joint.velocity_suffix, range(joint.num_velocities())):
                velocities.append(
                    Signal(f"{name}_{suffix}", "rad/s" if suffix[0] == "w" else "m/s")
                )
        self.position_signals, self.velocity_signals = tuple(positions), tuple(velocities)

    def _read_actuators(self) -> None:
        plant = self.plant
        every = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        actuators = sorted(every, key=lambda actuator: actuator.input_start())
        self.actuator_signals = tuple(
            Signal(name, "N m" if actuator.joint().position_suffix(0) == "q" else "N")
            for actuator, name in zip(actuators, unique_names(plant, actuators), strict=True)
        )
        self.actuation_matrix = np.array(plant.MakeActuationMatrix())
        self.effort_limits = np.array([a.effort_limit() for a in actuators])
        self.gear_ratios = np.array([a.default_gear_ratio() for a in actuators])
        for actuator, ratio in zip(actuators, self.gear_ratios, strict=True):
            if not (np.isfinite(ratio) and ratio != 0.0):
                raise ModelError(
                    f"the gear ratio of '{actuator.name()}' is {ratio:g}; it must be another number"
                )
        self.reflected_inertia = np.array([a.default_reflected_inertia() for a in actuators])
        # As in Drake, the last of several actuators of a joint is used.
        self._rotors = np.zeros(plant.num_velocities())
        for actuator in every:
            self._rotors[actuator.joint().velocity_start()] = actuator.default_reflected_inertia()

    def _read_masses(self) -> tuple[Parameter, ...]:
        """Makes every mass a parameter, and adds the bodies' inertias to their links.

        A point mass at its body's origin also has the parameter "<body>.center", its place.
        """
        bodies = [body for body in self._bodies if body.default_mass() > 0.0]
        parameters = []
        for body, name in zip(bodies, unique_names(self.plant, bodies), strict=True):
            parameter = Parameter(f"{name}.mass", body.default_mass(), "kg", positive=True)
            parameters.append(parameter)
            index, rotation, offset = self.on_link(body.body_frame())
            unit = body.default_unit_inertia().CopyToFullMatrix3()
            about_body = np.trace(unit) / 2 * np.eye(3) - unit
            lever = rotation @ body.default_com()
            second = rotation @ about_body @ rotation.T
            second += np.outer(lever, offset) + np.outer(offset, lever + offset)
            mass = parameter.symbol
            if unit.any() or lever.any():
                moments = lever + offset, second
                inertia = Inertia(mass, *(mass * ca.SX(without_round_off(m)) for m in moments))
            else:
                center = Parameter(f"{name}.center", np.zeros(3), "m")
                parameters.append(center)
                place = without_round_off(offset) + ca.mtimes(ca.SX(rotation), center.symbol)
                inertia = Inertia(mass, mass * place, mass * (place @ place.T))
            link = self.links[index]
            link.inertia += inertia
            if not self.plant.is_gravity_enabled(body.model_instance()):
                link.weightless += inertia
        return tuple(parameters)

    def _read_springs(self, joints: Sequence[Joint]) -> None:
        """The generalized force of dampers and springs, shape (nv, 1)."""
        for joint in joints:
            largest = np.max(joint.default_damping_vector(), initial=0.0)
            if largest > LARGEST:
                raise ModelError(
                    f"joint '{joint.name()}' has a damping of {largest:g}, and the largest that "
                    f"can be computed with is {LARGEST:g}"
                )
        damping = np.concatenate([joint.default_damping_vector() for joint in joints])
        force = -ca.SX(damping) * self.v
        for i in range(self.plant.num_force_elements()):
            match element := self.plant.get_force_element(ForceElementIndex(i)):
                case RevoluteSpring():
                    stiffness, rest = element.default_stiffness(), element.default_nominal_angle()
                case PrismaticSpring():
                    stiffness, rest = element.stiffness(), element.nominal_position()
                case LinearSpringDamper():
                    start = self.position(element.bodyA().body_frame(), element.p_AP())
                    end = self.position(element.bodyB().body_frame(), element.p_BQ())
                    length = length_of(end - start)
                    gradient = ca.jacobian(length, self.q) @ self.velocity_map
                    tension = element.stiffness() * (length - element.free_length())
                    tension += element.damping() * (gradient @ self.v)
                    force -= gradient.T @ tension
                    continue
                case UniformGravityFieldElement():
                    continue
                case _:
                    raise ModelError(
                        f"the plant has a force element of type {type(element).__name__}, which is "
                        "not supported; supported are UniformGravityFieldElement, RevoluteSpring, "
                        "PrismaticSpring and LinearSpringDamper"
                    )
            place = element.joint().position_start()
            force[place] += stiffness * (rest - self.q[place])
        self._spring_force = force

    @property
    def gravity(self) -> FloatArray:
        """Gravity in the world, m/s^2, shape (3,)."""
        return self.plant.gravity_field().gravity_vector()

    def _compare_with_plant(self) -> None:
        """Compares M, H and N v with the plant's own values at three random states."""
        names = "mass matrix", "bias", "velocity map"
        ours = self.mass_matrix, self.bias, self.velocity_map @ self.v
        symbols = ca.vertcat(ca.SX(0, 1), *[p.symbol for p in self.parameters])
        values = np.concatenate([np.zeros(0), *[p.value for p in self.parameters]])
        inputs = {"q": self.q, "v": self.v, "parameters": symbols}
        function = TracedFunction("comparison", inputs, dict(zip(names, ours, strict=True)))
        plant, random = self.plant, np.random.default_rng(0)
        context = plant.CreateDefaultContext()
        for _ in range(3):
            state = random.uniform(-1.0, 1.0, (2, self.v.numel()))
            plant.SetPositions(context, state[0])
            plant.SetVelocities(context, state[1])
            forces = MultibodyForces(plant)
            plant.CalcForceElementsContribution(context, forces)
            applied = plant.CalcGeneralizedForces(context, forces)
            mass = plant.CalcMassMatrix(context)
            rates = plant.MapVelocityToQDot(context, state[1])
            theirs = mass, plant.CalcBiasTerm(context) - applied, rates
            if not (np.abs(mass).max() > 0.0 and all(np.isfinite(t).all() for t in theirs)):
                raise ModelError(
                    "the plant's own mass matrix is zero or not finite: no mass or inertia moves "
                    "with a joint; give each moving link an <inertial>, or weld it to one that has"
                )
            # Forces that cancel have no scale of their own.
            scales = np.abs(mass).max(), np.abs(mass).max(), 1.0
            own = function(*state, values)
            for name, one, other, scale in zip(names, own, theirs, scales, strict=True):
                apart = np.abs(one.reshape(other.shape) - other).max()
                if not (error := apart / max(np.abs(other).max(), scale)) <= TOLERANCE:
                    raise ModelError(
                        f"{name} differs from the plant's own by {error:.1e} (relative) at q = "
                        f"{state[0]}, v = {state[1]}; this is an error in drake_dae, please report "
                        "the model"
                    )


@dataclass(frozen=True, eq=False)
class _FrameSymbols:
    """The symbols of a moving frame, in the world; R' besides w saves products."""

    rotation: ca.SX = field(default_factory=lambda: ca.SX.sym("R", 3, 3))
    rotation_rate: ca.SX = field(default_factory=lambda: ca.SX.sym("R'", 3, 3))
    origin: ca.SX = field(default_factory=lambda: ca.SX.sym("p", 3))
    velocity: ca.SX = field(default_factory=lambda: ca.SX.sym("p'", 3))
    spin: ca.SX = field(default_factory=lambda: ca.SX.sym("w", 3))


class TreeKinematics(Kinematics):
    """The frames of a plant in motion; `moving` is how each link moves.

    Constraints are differentiated by symbols of frames: recursions give the motion of these in far
    fewer operations than derivatives through the joints.
    """

    _links: MultibodyExpressions

    def __init__(
        self, links: MultibodyExpressions, acceleration: ca.SX, moving: Sequence[LinkMotion]
    ) -> None:
        super().__init__(links, acceleration)
        self.moving, self._links = moving, links
        self._symbols: dict[int, tuple[Frame, _FrameSymbols]] = {}

    def rotation(self, frame: str | Frame) -> ca.SX:
        return self._pose(frame)[0]

    def position(self, frame: str | Frame, point: ArrayLike = ORIGIN) -> ca.SX:
        return position_of(self._pose(frame), point)

    def angular_velocity(self, frame: str | Frame) -> ca.SX:
        symbols = self._moving(self._links.find(frame))
        return ca.SX.zeros(3) if symbols is None else symbols.spin

    def velocity(self, frame: str | Frame, point: ArrayLike = ORIGIN) -> ca.SX:
        symbols, offset = self._moving(self._links.find(frame)), vector("a point", point, 3)
        if symbols is None:
            return ca.SX.zeros(3)
        return symbols.velocity + symbols.rotation_rate @ ca.SX(offset)

    def derivative(self, expression: ca.SX) -> ca.SX:
        moving = [
            (self.q, ca.mtimes(self._links.velocity_map, self.v)),
            (self.v, self.acceleration),
        ]
        for frame, symbols in self._symbols.values():
            index, turn, lever = self._links.on_link(frame)
            R_WL, link = self._links.link_poses[index][0], self.moving[index]
            falling = link.acceleration + link.gradient @ ca.SX(lever)
            moving += [
                (symbols.rotation, symbols.rotation_rate),
                (symbols.rotation_rate, R_WL @ (link.gradient @ ca.SX(turn))),
                (symbols.origin, symbols.velocity),
                (symbols.velocity, R_WL @ falling + ca.SX(self._links.gravity)),
                (symbols.spin, R_WL @ link.spin_rate),
            ]
        places, rates = (ca.vertcat(*map(ca.vec, column)) for column in zip(*moving, strict=True))
        return ca.jtimes(expression, places, rates)

    def reaction(self, power: ca.SX) -> Reaction:
        wrenches = {}
        for frame, symbols in self._symbols.values():
            velocities = ca.veccat(symbols.velocity, symbols.rotation_rate, symbols.spin)
            if not ca.depends_on(power, velocities):
                continue
            slope = ca.gradient(power, symbols.rotation_rate)
            moment = ca.gradient(power, symbols.spin)
            for k in range(3):
                moment += ca.cross(symbols.rotation[:, k], slope[:, k])
            wrenches[frame] = (ca.gradient(power, symbols.velocity), moment)
        return Reaction(ca.sparsify(ca.gradient(power, self.v)), wrenches)

    def joint_axis(self, position: str) -> Application | None:
        plant, place = self._links.plant, position_index(self, position)
        for index in plant.GetJointIndices():
            joint = plant.get_joint(index)
            if joint.num_positions() == 1 and joint.position_start() == place:
                break
        else:
            return None
        (*_, last), rotation = elementary_joints(plant, joint)  # The rotation of a screw joint.
        frame = joint.frame_on_child()
        along, none = self.rotation(frame) @ ca.SX(rotation @ last.directions), ca.SX(3, 1)
        child, parent = (
            frame_name(plant, body.body_frame())
            for body in (joint.child_body(), joint.parent_body())
        )
        axes = (along, none) if last.axis is None else (none, along)
        return Application(self.position(frame), *axes, child, parent)

    def value(self, expression: ca.SX) -> ca.SX:
        pairs = [pair for entry in self._symbols.values() for pair in self._values(*entry)]
        symbols, values = ([ca.vec(pair[i]) for pair in pairs] for i in (0, 1))
        return ca.substitute(expression, ca.vertcat(*symbols), ca.vertcat(*values))

    def _values(self, frame: Frame, symbols: _FrameSymbols) -> list[tuple[ca.SX, ca.SX]]:
        """Each symbol of a frame, and its expression."""
        index, turn, lever = self._links.on_link(frame)
        R_WL, link = self._links.link_poses[index][0], self.moving[index]
        R_WF, p_WF = self._links.pose(frame)
        return [
            (symbols.rotation, R_WF),
            (symbols.rotation_rate, R_WL @ (ca.skew(link.spin) @ ca.SX(turn))),
            (symbols.origin, p_WF),
            (symbols.velocity, R_WL @ (link.velocity + ca.cross(link.spin, ca.SX(lever)))),
            (symbols.spin, R_WL @ link.spin),
        ]

    def _pose(self, frame: str | Frame) -> tuple[ca.SX, ca.SX]:
        resolved = self._links.find(frame)
        symbols = self._moving(resolved)
        return self._links.pose(resolved) if symbols is None else (symbols.rotation, symbols.origin)

    def _moving(self, frame: Frame) -> _FrameSymbols | None:
        """The symbols of a frame; None if it is fixed to the world."""
        if self._links.on_link(frame)[0] == 0:
            return None
        return self._symbols.setdefault(int(frame.index()), (frame, _FrameSymbols()))[1]
