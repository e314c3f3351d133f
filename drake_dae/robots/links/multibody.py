"""The equations of motion of a MultibodyPlant as CasADi expressions."""

from collections import Counter
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    ForceElementIndex,
    Frame,
    FrameIndex,
    Joint,
    LinearSpringDamper,
    MultibodyForces,
    PrismaticSpring,
    RevoluteSpring,
    UniformGravityFieldElement,
)

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.links.joints import (
    check_joint,
    clean,
    constant_pose,
    joint_motions,
    joint_velocity_map,
    read_links,
)
from drake_dae.robots.links.links import Residual
from drake_dae.robots.links.tree import (
    Inertia,
    frame_jacobian,
    inverse_dynamics,
    link_motions,
    link_poses,
    mass_matrix,
)
from drake_dae.trace.functions import TracedFunction

SUPPORTED_FORCE_ELEMENTS = (
    UniformGravityFieldElement,
    RevoluteSpring,
    PrismaticSpring,
    LinearSpringDamper,
)


class MultibodyExpressions:
    """The equations of motion of a finalized MultibodyPlant,

        M(q) v' + H(q, v) = B u,    q' = N(q) v,

    as CasADi SX expressions, by the composite rigid body and the recursive Newton-Euler algorithm
    in link frames (Featherstone, Rigid Body Dynamics Algorithms, 2008). H holds the Coriolis and
    centrifugal forces, gravity, joint damping, and the springs RevoluteSpring, PrismaticSpring
    and LinearSpringDamper; M holds the reflected inertia of the rotors. Contact, locked joints
    and the PD controllers of actuators are no part of it: u is what the joints feel.

    All data comes from the plant and is in SI units (m, kg, s, rad, N, N m); q, v and u have
    Drake's order. On construction M, N and every part of H are compared with the plant's own
    values at random states.

    Attributes:
        plant: The plant.
        q, v: Symbols, shapes (nq, 1) and (nv, 1), with nq = nv.
        parameters: The mass in kg of every body that has one, "<body>.mass". As in
            RigidBody.SetMass, centre of mass and unit inertia stay when it changes.
        position_signals, velocity_signals: Names and units of q ("joint1", "base_qx") and of v
            ("joint1_w", "base_wx"), unique in both together; a joint name that several model
            instances use is written "instance::joint1".
        actuator_signals: Names and units of u.
        velocity_map: N, shape (nq, nv).
        mass_matrix: M, shape (nv, nv), structurally zero between branches.
        bias: H, shape (nv, 1).
        actuation_matrix: B, shape (nv, nu).
        effort_limits: Shape (nu,), inf where there is none. Drake's plant clips u to them; these
            equations do not.
        reflected_inertia, gear_ratios: Of the actuators, in kg m^2 (kg) and without unit, (nu,).
        position_limits, velocity_limits: Lower and upper, shapes (nq,) and (nv,).
        default_positions: Shape (nq,).

    Raises:
        ModelError: The plant is not finalized, cannot move, or has a constraint, joint or force
            element that is not supported; or the comparison with the plant failed.
    """

    def __init__(self, plant: MultibodyPlant) -> None:
        self.plant = plant
        self._check_support()
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        self._moving = sorted(
            (joint for joint in joints if joint.num_velocities() > 0),
            key=lambda joint: joint.velocity_start(),
        )
        self._actuators = sorted(
            (plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()),
            key=lambda actuator: actuator.input_start(),
        )
        self.position_signals, self.velocity_signals = self._read_signals()
        self.q = ca.vertcat(*[ca.SX.sym(signal.name) for signal in self.position_signals])
        self.v = ca.vertcat(*[ca.SX.sym(signal.name) for signal in self.velocity_signals])
        self.actuator_signals = tuple(
            Signal(name, "N m" if self._is_turned(actuator.joint()) else "N")
            for actuator, name in zip(self._actuators, self._names(self._actuators), strict=True)
        )
        self.actuation_matrix = np.array(plant.MakeActuationMatrix())
        self.effort_limits = np.array([actuator.effort_limit() for actuator in self._actuators])
        self.gear_ratios = np.array([a.default_gear_ratio() for a in self._actuators])
        self.reflected_inertia = np.array(
            [actuator.default_reflected_inertia() for actuator in self._actuators]
        )
        self.position_limits = (plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
        self.velocity_limits = (plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits())
        self.default_positions = plant.GetDefaultPositions()

        self._links, self._bodies = read_links(plant, self.q)
        self.parameters = self._read_masses()
        self._frames: dict[int, tuple[ca.SX, ca.SX]] = {}

        self.velocity_map = ca.diagcat(
            *[
                joint_velocity_map(joint, self.q[i : i + joint.num_positions()])
                for joint, i in ((joint, joint.position_start()) for joint in self._moving)
            ]
        )
        self.mass_matrix = mass_matrix(self._links, self._rotors())
        gravity = plant.gravity_field().gravity_vector()
        self.bias = self._newton_euler(self.v, gravity) - self._applied_force
        self._compare_with_plant()

    def rotation(self, frame: str | Frame) -> ca.SX:
        """R_WF, shape (3, 3): the orientation of a frame in the world.

        Args:
            frame: A frame of the plant, or its name; "instance::name" if several have that name.

        Raises:
            ModelError: No frame, or more than one, has that name.
        """
        return self._frame_pose(frame)[0]

    def position(self, frame: str | Frame, point: ArrayLike = (0.0, 0.0, 0.0)) -> ca.SX:
        """p_W in m, shape (3, 1): where a point fixed in a frame is in the world.

        Args:
            frame: As for `rotation`.
            point: Shape (3,), in m, in the frame.

        Raises:
            ModelError: No frame, or more than one, has that name; or a point that is not finite.
        """
        return _point(self._frame_pose(frame), point)

    def jacobian(self, phi: Residual) -> ca.SX:
        """J = (dphi/dq) N of constraints phi(q), shape (m, nv), by those of the frames."""
        poses = _PoseSymbols(self)
        residual = phi(poses)
        result = ca.mtimes(poses.replace(ca.jacobian(residual, self.q)), self.velocity_map)
        for frame, (rotation, origin) in poses.symbols.items():
            link = self._bodies[int(frame.body().index())][0]
            turn = sum(
                (
                    ca.mtimes(ca.jacobian(residual, rotation[:, k]), -ca.skew(rotation[:, k]))
                    for k in range(3)
                ),
                ca.SX(residual.numel(), 3),
            )
            by_twist = ca.sparsify(ca.horzcat(ca.jacobian(residual, origin), turn))
            twist = frame_jacobian(self._links, link, self._frame_pose(frame)[1], self.v.numel())
            result += ca.mtimes(poses.replace(by_twist), twist)
        return result

    def motion(self, acceleration: ca.SX, phi: Residual, multiplier: ca.SX) -> tuple[ca.SX, ca.SX]:
        """M v' + H - J^T lambda of (37), shape (nv, 1), and phi'', shape (m, 1).

        The constraint forces are wrenches on frames in the recursive Newton-Euler algorithm, which
        also gives the accelerations of the frames: neither M nor J is formed.
        """
        gravity = self.plant.gravity_field().gravity_vector()
        motions = link_motions(self._links, self.v, acceleration, gravity)
        poses = _PoseSymbols(self)
        residual = phi(poses)
        power = ca.dot(multiplier, residual)
        wrenches: dict[int, tuple[ca.SX, ca.SX]] = {}
        velocity = ca.mtimes(self.velocity_map, self.v)
        moving = [(self.q, velocity, self._rate(velocity, acceleration))]
        for frame, (rotation, origin) in poses.symbols.items():
            index, X_LB = self._bodies[int(frame.body().index())]
            turn, lever = map(ca.SX, constant_pose(X_LB @ frame.GetFixedPoseInBodyFrame()))
            R_WL, link = self._link_poses[index][0], motions[index]
            force, slope = ca.gradient(power, origin), ca.gradient(power, rotation)
            moment = sum((ca.cross(rotation[:, k], slope[:, k]) for k in range(3)), ca.SX(3, 1))
            force = ca.mtimes(R_WL.T, poses.replace(force))
            moment = ca.mtimes(R_WL.T, poses.replace(moment)) + ca.cross(lever, force)
            own = wrenches.get(index, (ca.SX(3, 1), ca.SX(3, 1)))
            wrenches[index] = own[0] + moment, own[1] + force
            # R' = R_WL [w] R_LF and R'' = R_WL gradient R_LF, with the link's spin w.
            moving.append(
                (
                    ca.vec(rotation),
                    ca.vec(R_WL @ (ca.skew(link.spin) @ turn)),
                    ca.vec(R_WL @ (link.gradient @ turn)),
                )
            )
            moving.append(
                (
                    origin,
                    R_WL @ (link.velocity + ca.cross(link.spin, lever)),
                    R_WL @ (link.acceleration + link.gradient @ lever) + ca.SX(gravity),
                )
            )
        place, first, second = (ca.vertcat(*column) for column in zip(*moving, strict=True))
        speed = ca.SX.sym("speed", first.numel())
        rate = ca.jtimes(residual, place, speed)
        twice = ca.jtimes(rate, ca.vertcat(place, speed), ca.vertcat(speed, second))
        twice = poses.replace(ca.substitute(twice, speed, first))
        force = inverse_dynamics(self._links, motions, gravity, self.v.numel(), wrenches)
        force += ca.SX(self._rotors()) * acceleration - self._applied_force
        force -= ca.mtimes(self.velocity_map.T, poses.replace(ca.gradient(power, self.q)))
        return force, twice

    def _rate(self, velocity: ca.SX, acceleration: ca.SX) -> ca.SX:
        """q'' for q' = N(q) v."""
        moving = ca.vertcat(self.q, self.v)
        return ca.jtimes(velocity, moving, ca.vertcat(velocity, acceleration))

    @cached_property
    def kinetic_energy(self) -> ca.SX:
        """v^T M v / 2 in J, a scalar; it includes the rotors."""
        return ca.dot(self.v, self.mass_matrix @ self.v) / 2

    @cached_property
    def potential_energy(self) -> ca.SX:
        """Of gravity and springs in J, a scalar; as in Drake, gravity is zero at height 0."""
        gravity = ca.SX(self.plant.gravity_field().gravity_vector())
        energy = ca.SX(0)
        for link, (rotation, origin) in zip(self._links, self._link_poses, strict=True):
            mass = link.inertia.mass - link.weightless.mass
            first = link.inertia.first - link.weightless.first
            energy -= ca.dot(gravity, mass * origin + rotation @ first)
        for i, stiffness, nominal in self._joint_springs:
            energy += stiffness / 2 * (nominal - self.q[i]) ** 2
        for spring, length in self._linear_springs:
            energy += spring.stiffness() / 2 * (length - spring.free_length()) ** 2
        return energy

    # What is refused.

    def _check_support(self) -> None:
        if not isinstance(self.plant, MultibodyPlant) or not self.plant.is_finalized():
            raise ModelError("a finalized MultibodyPlant is needed; call plant.Finalize() first")
        if self.plant.num_constraints() > 0:
            raise ModelError(
                f"the plant has {self.plant.num_constraints()} constraint(s), which Drake ignores "
                "in continuous time; leave them out of the plant and hand them to RobotModel as "
                "`constraints`"
            )
        for joint_index in self.plant.GetJointIndices():
            check_joint(self.plant.get_joint(joint_index))
        for element in self._force_elements:
            if not isinstance(element, SUPPORTED_FORCE_ELEMENTS):
                names = ", ".join(supported.__name__ for supported in SUPPORTED_FORCE_ELEMENTS)
                raise ModelError(
                    f"the plant has a force element of type {type(element).__name__}, which is "
                    f"not supported; supported are {names}"
                )
        if self.plant.num_velocities() == 0:
            raise ModelError("the plant has no joint that moves")

    # What is read from the plant.

    @cached_property
    def _force_elements(self) -> list[Any]:
        count = self.plant.num_force_elements()
        return [self.plant.get_force_element(ForceElementIndex(i)) for i in range(count)]

    def _names(self, items: Sequence[Any]) -> list[str]:
        """Names of joints, bodies or actuators, with the model instance where they collide."""
        count = Counter(item.name() for item in items)
        return [item.name() if count[item.name()] == 1 else self._scoped(item) for item in items]

    def _scoped(self, item: Any) -> str:
        return f"{self.plant.GetModelInstanceName(item.model_instance())}::{item.name()}"

    def _is_turned(self, joint: Joint, k: int = 0) -> bool:
        """Whether the k-th position and velocity of a joint are angular."""
        motions = joint_motions(self.plant, joint).motions
        return any(joint.position_start() + k in m.positions for m in motions if m.is_turn)

    def _read_signals(self) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
        positions, velocities = [], []
        for joint, name in zip(self._moving, self._names(self._moving), strict=True):
            for k in range(joint.num_positions()):
                suffix = f"_{joint.position_suffix(k)}" if joint.num_positions() > 1 else ""
                unit = "rad" if self._is_turned(joint, k) else "m"
                positions.append(Signal(f"{name}{suffix}", unit))
                velocities.append(Signal(f"{name}_{joint.velocity_suffix(k)}", f"{unit}/s"))
        return tuple(positions), tuple(velocities)

    def _read_masses(self) -> tuple[Parameter, ...]:
        """Makes a parameter of every mass, and adds the bodies' inertias to their links."""
        every = [self.plant.get_body(BodyIndex(i)) for i in range(self.plant.num_bodies())]
        bodies = [body for body in every if body.default_mass() > 0.0]
        parameters = []
        for body, name in zip(bodies, self._names(bodies), strict=True):
            parameter = Parameter(f"{name}.mass", body.default_mass(), "kg", positive=True)
            parameters.append(parameter)
            index, X_LB = self._bodies[int(body.index())]
            rotation, offset = constant_pose(X_LB)
            unit = body.default_unit_inertia().CopyToFullMatrix3()
            about_body = np.trace(unit) / 2 * np.eye(3) - unit
            lever = rotation @ body.default_com()
            second = rotation @ about_body @ rotation.T
            second += np.outer(lever, offset) + np.outer(offset, lever + offset)
            inertia = Inertia.of_mass(parameter.symbol, clean(lever + offset), clean(second))
            link = self._links[index]
            link.inertia += inertia
            if not self.plant.is_gravity_enabled(body.model_instance()):
                link.weightless += inertia
        return tuple(parameters)

    def _rotors(self) -> FloatArray:
        """Reflected inertia of the rotors, shape (nv,)."""
        inertia = np.zeros(self.plant.num_velocities())
        for index in self.plant.GetJointActuatorIndices():
            actuator = self.plant.get_joint_actuator(index)
            # As in Drake, where a joint has several actuators the last one counts.
            inertia[actuator.joint().velocity_start()] = actuator.default_reflected_inertia()
        return inertia

    # Springs and damping.

    @cached_property
    def _applied_force(self) -> ca.SX:
        """Generalized forces of joint damping and springs, shape (nv, 1)."""
        damping = np.concatenate([joint.default_damping_vector() for joint in self._moving])
        force = -ca.SX(damping) * self.v
        for i, stiffness, nominal in self._joint_springs:
            force[i] += stiffness * (nominal - self.q[i])
        for spring, length in self._linear_springs:
            gradient = ca.jacobian(length, self.q) @ self.velocity_map
            tension = spring.stiffness() * (length - spring.free_length())
            tension += spring.damping() * (gradient @ self.v)
            force -= gradient.T @ tension
        return force

    @cached_property
    def _joint_springs(self) -> list[tuple[int, float, float]]:
        """Index in q and v, stiffness, and nominal position of every spring in a joint."""
        springs = []
        for element in self._force_elements:
            if isinstance(element, RevoluteSpring):
                stiffness, nominal = element.default_stiffness(), element.default_nominal_angle()
                springs.append((element.joint().position_start(), stiffness, nominal))
            if isinstance(element, PrismaticSpring):
                stiffness, nominal = element.stiffness(), element.nominal_position()
                springs.append((element.joint().position_start(), stiffness, nominal))
        return springs

    @cached_property
    def _linear_springs(self) -> list[tuple[LinearSpringDamper, ca.SX]]:
        """Every spring between two points, and its length in m."""
        springs = []
        for element in self._force_elements:
            if isinstance(element, LinearSpringDamper):
                start = self.position(element.bodyA().body_frame(), element.p_AP())
                end = self.position(element.bodyB().body_frame(), element.p_BQ())
                springs.append((element, ca.norm_2(end - start)))
        return springs

    # Frames.

    @cached_property
    def _link_poses(self) -> list[tuple[ca.SX, ca.SX]]:
        return link_poses(self._links)

    def _frame_pose(self, frame: str | Frame) -> tuple[ca.SX, ca.SX]:
        """R_WF and p_WF."""
        found = self._frame(frame)
        index = int(found.index())
        if index not in self._frames:
            link, X_LB = self._bodies[int(found.body().index())]
            rotation, offset = constant_pose(X_LB @ found.GetFixedPoseInBodyFrame())
            R_WL, p_WL = self._link_poses[link]
            self._frames[index] = (R_WL @ ca.SX(rotation), p_WL + R_WL @ ca.SX(offset))
        return self._frames[index]

    def _frame(self, frame: str | Frame) -> Frame:
        found = self._find_frame(frame) if isinstance(frame, str) else frame
        if found.GetParentPlant() is not self.plant:
            raise ModelError(f"frame '{found.name()}' belongs to another plant")
        return found

    def _find_frame(self, name: str) -> Frame:
        if name == "world":
            return self.plant.world_frame()
        frames = [self.plant.get_frame(FrameIndex(i)) for i in range(self.plant.num_frames())]
        matches = [frame for frame in frames if name in (frame.name(), self._scoped(frame))]
        if len(matches) == 1:
            return matches[0]
        if matches:
            scoped = ", ".join(self._scoped(frame) for frame in matches)
            raise ModelError(f"the plant has several frames '{name}'; say which: {scoped}")
        # Drake's parser adds frames of its own at joints whose axis it has to turn.
        names = [name for name in self._names(frames) if not name.endswith(("_parent_F", "_M"))]
        near = get_close_matches(name, names, n=3)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise ModelError(f"the plant has no frame '{name}'; {hint}frames: {', '.join(names)}")

    def _newton_euler(self, v: ca.SX, gravity: FloatArray) -> ca.SX:
        """Generalized forces at velocities v without acceleration, shape (nv, 1)."""
        motions = link_motions(self._links, v, ca.SX(v.numel(), 1), gravity)
        return inverse_dynamics(self._links, motions, gravity, v.numel())

    # The comparison with the plant.

    def _compare_with_plant(self) -> None:
        """Compares every expression with the plant's own value at three random states.

        The error of a quantity is its largest absolute difference, over its own largest entry or
        over that of M if that is larger: forces that cancel have no scale of their own.
        """
        plant = self.plant
        gravity = -self._newton_euler(
            ca.SX.zeros(self.v.numel()), plant.gravity_field().gravity_vector()
        )
        inputs = {
            "q": self.q,
            "v": self.v,
            "masses": ca.vertcat(ca.SX(0, 1), *[p.symbol for p in self.parameters]),
        }
        ours = {
            "mass matrix": self.mass_matrix,
            "Coriolis and centrifugal forces": self._newton_euler(self.v, np.zeros(3)),
            "gravity": gravity,
            "force elements and damping": gravity + self._applied_force,
            "bias": self.bias,
            "velocity map": self.velocity_map @ self.v,
        }
        masses = np.concatenate([np.zeros(0), *[p.value for p in self.parameters]])
        function = TracedFunction("comparison", inputs, ours)
        context = plant.CreateDefaultContext()
        forces = MultibodyForces(plant)
        random = np.random.default_rng(0)
        for _ in range(3):
            q, v = random.uniform(-1.0, 1.0, (2, self.v.numel()))
            plant.SetPositions(context, q)
            plant.SetVelocities(context, v)
            plant.CalcForceElementsContribution(context, forces)
            applied = plant.CalcGeneralizedForces(context, forces)
            inertial = plant.CalcBiasTerm(context)
            M = plant.CalcMassMatrix(context)
            theirs = (
                M,
                inertial,
                plant.CalcGravityGeneralizedForces(context),
                applied,
                inertial - applied,
                plant.MapVelocityToQDot(context, v),
            )
            for name, own, other in zip(ours, function(q, v, masses), theirs, strict=True):
                scale = max(np.abs(other).max(), 1.0 if name == "velocity map" else np.abs(M).max())
                error = np.abs(own - other).max() / scale
                # Round-off gives 1e-14; any modelling error shows far above 1e-10.
                if not np.all(np.isfinite(other)):
                    raise ModelError(
                        f"the plant's own {name} is not finite at q = {q}: a joint moves no mass; "
                        "give each moving link mass and inertia, or weld it"
                    )
                if not error <= 1e-10:
                    raise ModelError(
                        f"{name} differs from the plant's own by {error:.1e} (relative) at "
                        f"q = {q}, v = {v}; this is an error in drake_dae, please report the model"
                    )


class _PoseSymbols:
    """Stands in for links: the poses of their frames are symbols, to differentiate by them."""

    def __init__(self, links: MultibodyExpressions) -> None:
        self._links = links
        self._poses: dict[int, tuple[Frame, ca.SX, ca.SX]] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._links, name)

    @property
    def symbols(self) -> dict[Frame, tuple[ca.SX, ca.SX]]:
        """Frame -> (R_WF, p_WF), of those that were asked for and can move."""
        return {frame: (rotation, origin) for frame, rotation, origin in self._poses.values()}

    def rotation(self, frame: str | Frame) -> ca.SX:
        return self._pose(frame)[0]

    def position(self, frame: str | Frame, point: ArrayLike = (0.0, 0.0, 0.0)) -> ca.SX:
        return _point(self._pose(frame), point)

    def replace(self, expression: ca.SX) -> ca.SX:
        """The symbols replaced by the poses that they stand for."""
        pairs = [
            (symbol, value)
            for frame, *pose in self._poses.values()
            for symbol, value in zip(pose, self._links._frame_pose(frame), strict=True)
        ]
        symbols, values = ([ca.vec(pair[i]) for pair in pairs] for i in (0, 1))
        return ca.substitute(expression, ca.vertcat(*symbols), ca.vertcat(*values))

    def _pose(self, frame: str | Frame) -> tuple[ca.SX, ca.SX]:
        found = self._links._frame(frame)
        if self._links._bodies[int(found.body().index())][0] == 0:
            return self._links._frame_pose(found)
        symbols = (found, ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3))
        return self._poses.setdefault(int(found.index()), symbols)[1:]


def _point(pose: tuple[ca.SX, ca.SX], point: ArrayLike) -> ca.SX:
    """Where a point of a frame with this pose is in the world."""
    offset = np.array(point, dtype=float)
    if offset.shape != (3,) or not np.all(np.isfinite(offset)):
        raise ModelError(f"a point has 3 finite coordinates, got {point!r}")
    rotation, origin = pose
    return origin + rotation @ ca.SX(offset)
