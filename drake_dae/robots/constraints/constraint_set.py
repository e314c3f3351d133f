"""All constraints of a robot together.                                              (37), (38)"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Parameter, Signal, UnilateralInput
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Constraint, Joint
from drake_dae.robots.links.links import Application, Frames, Kinematics, Links, Reaction


@dataclass(frozen=True)
class ConstraintSet:
    """The constraints of a robot, stacked in the order of their constraint forces."""

    constraints: Sequence[Constraint]

    @property
    def size(self) -> int:
        """m, the number of constraint forces."""
        return len(self.force_signals)

    @cached_property
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of lambda."""
        return tuple(s for c in self.constraints for s in c.force_signals)

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return tuple(s for c in self.constraints for s in c.residual_signals)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(p for c in self.constraints for p in c.parameters)

    def place(self, name: str) -> int:
        """The index of a constraint force in lambda; ModelError if there is none."""
        names = [signal.name for signal in self.force_signals]
        if name not in names:
            raise ModelError(unknown_name("constraint force", name, names))
        return names.index(name)

    def parts(self) -> Iterator[tuple[Constraint, slice]]:
        """Each constraint, and the slice of its constraint forces."""
        start = 0
        for constraint in self.constraints:
            stop = start + len(constraint.force_signals)
            yield constraint, slice(start, stop)
            start = stop

    def residual(self, frames: Frames) -> ca.SX:
        """phi(q) of the rows that restrict positions, shape (k, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[c.residual(frames) for c in self.constraints])  # (38)

    def rate(self, kinematics: Kinematics) -> ca.SX:
        """phi'(q, v), and the rates of rows that restrict velocities alone, shape (m, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[c.rate(kinematics) for c in self.constraints])

    def constraint_output(self, kinematics: Kinematics) -> ca.SX:
        """k of (2), shape (m, 1): phi, and the rate of rows that restrict velocities alone."""
        rows = [ca.SX(0, 1)]
        for constraint in self.constraints:
            residual = constraint.residual(kinematics)
            rows.append(residual)
            if residual.numel() < len(constraint.force_signals):
                rows.append(constraint.rate(kinematics)[residual.numel() :])
        return kinematics.value(ca.vertcat(*rows))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        """The reaction on the robot of the constraint forces, shape (m, 1)."""
        total = Reaction(ca.SX(kinematics.v.numel(), 1))
        for constraint, part in self.parts():
            total += constraint.reaction(kinematics, constraint_force[part])
        return total

    def force_matrix(self, links: Links) -> ca.SX:
        """G of M v' + H = G lambda + B tau, shape (nv, m): J^T without friction."""
        kinematics, force = links.kinematics(), ca.SX.sym("force", self.size)
        # (41)
        columns = self.reaction(kinematics, force).map(lambda part: ca.jacobian(part, force))
        return links.generalized_force(kinematics, columns)

    def implicit(self, links: Links, acceleration: ca.SX, force: ca.SX) -> tuple[ca.SX, ca.SX]:
        """M v' + H - G lambda, shape (nv, 1), and phi'', shape (m, 1), without M and J."""  # (38)
        kinematics = links.kinematics(acceleration)
        balance = links.inverse_dynamics(kinematics, self.reaction(kinematics, force))
        return balance, kinematics.value(kinematics.derivative(self.rate(kinematics)))

    def drag(self, links: Links) -> ca.SX:
        """The generalized force of constraints independent of lambda, shape (nv, 1)."""
        total, kinematics = ca.SX(links.v.numel(), 1), links.kinematics()
        for constraint in self.constraints:
            reaction = constraint.drag(kinematics)
            if reaction is not None:
                total += links.generalized_force(kinematics, reaction)
        return total

    def acting(self, kinematics: Kinematics) -> list[tuple[Constraint, slice, Application]]:
        """The constraints that act at a point, slices of their forces, and their first points."""
        return [
            (constraint, part, application)
            for constraint, part in self.parts()
            for application in constraint.applications(kinematics)[:1]
        ]

    def force_on(
        self, frame: str, name: str, kinematics: Kinematics, constraint_force: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """The point and force in N of a constraint on a frame, both in the world, shapes (3, 1)."""
        parts = {constraint.name: (constraint, part) for constraint, part in self.parts()}
        if name not in parts:
            raise ModelError(unknown_name("constraint", name, parts))
        constraint, part = parts[name]
        acting = constraint.applications(kinematics)
        on_frame = [a for a in acting if frame in (a.frame_a, a.frame_b)]
        if len(on_frame) != 1:
            frames = ", ".join(dict.fromkeys(f for a in acting for f in (a.frame_a, a.frame_b)))
            where = "at several points of" if on_frame else "not on"
            raise ModelError(
                f"constraint '{name}' acts {where} '{frame}', and exactly one point on it is "
                f"needed; it acts on {frames or 'no known frame'}"
            )
        sign = 1.0 if frame == on_frame[0].frame_b else -1.0
        return on_frame[0].point, sign * on_frame[0].force(constraint_force[part])

    def wrenches(
        self, kinematics: Kinematics, constraint_force: ca.SX
    ) -> tuple[ca.SX, tuple[Signal, ...]]:
        """The moment and force of each constraint on each of its frames, as Drake's SpatialForce.

        In the world, the force at the frame's origin, with signals "<constraint>.<frame>.mx", ...
        """
        rows, names = [ca.SX(0, 1)], []
        for constraint, part in self.parts():
            by_frame: dict[str, ca.SX] = {}
            for application in constraint.applications(kinematics):
                force = application.force(constraint_force[part])
                moment = ca.mtimes(application.moment_axes, constraint_force[part])
                for frame, sign in ((application.frame_b, 1.0), (application.frame_a, -1.0)):
                    lever = application.point - kinematics.position(frame)
                    wrench = ca.vertcat(moment + ca.cross(lever, force), force)
                    by_frame[frame] = by_frame.get(frame, ca.SX(6, 1)) + sign * wrench
            rows += by_frame.values()
            names += [f"{constraint.name}.{frame}" for frame in by_frame]
        parts = (("mx", "N m"), ("my", "N m"), ("mz", "N m"), ("fx", "N"), ("fy", "N"), ("fz", "N"))
        signals = tuple(Signal(f"{name}.{part}", unit) for name in names for part, unit in parts)
        return kinematics.value(ca.vertcat(*rows)), signals

    @property
    def joints(self) -> tuple[tuple[Constraint, Joint], ...]:
        """The joints that close loops, with their properties along the coordinate."""
        pairs = ((constraint, constraint.joint) for constraint in self.constraints)
        return tuple((constraint, joint) for constraint, joint in pairs if joint is not None)

    @property
    def motors(self) -> tuple[Signal, ...]:
        """Names and units of the motors' efforts in the loop-closing joints."""
        return tuple(joint.motor for _, joint in self.joints if joint.motor is not None)

    def contacts(self, links: Links) -> tuple[UnilateralInput, ...]:
        """The unilateral constraint forces, if friction acts on one of them."""
        kinematics, contacts = links.kinematics(), []
        for constraint in self.constraints:
            sliding = constraint.sliding(kinematics)
            sliding = None if sliding is None else kinematics.value(sliding)
            contacts += [
                UnilateralInput(signal.name, constraint.friction_parameter, sliding)
                for signal, pushes in zip(
                    constraint.force_signals, constraint.is_unilateral, strict=True
                )
                if pushes
            ]
        return tuple(contacts) if any(contact.friction for contact in contacts) else ()


class LoopState:
    """The l joints of a robot that close loops: (c, c') as `state`, with `signals` and `limits`.

    `force` is the generalized force of their springs and dampers, shape (nv, 1), `columns` and
    `motors` are those of unit efforts in all joints and in those with motors, shape (nv, k).
    """

    def __init__(self, constraints: ConstraintSet, links: Links) -> None:
        members, kinematics = constraints.joints, links.kinematics()
        joints = [joint for _, joint in members]
        coordinates = [c.coordinates(kinematics) for c, _ in members]
        rates = [kinematics.derivative(c) for c in coordinates]
        position = kinematics.value(ca.vertcat(ca.SX(0, 1), *coordinates))
        rate = kinematics.value(ca.vertcat(ca.SX(0, 1), *rates))
        self.state = ca.vertcat(position, rate)
        named = [signal for c, _ in members for signal in c.coordinate_signals]
        self.signals = (*named, *(signal.derivative(1) for signal in named))
        fastest = [joint.velocity_limit for joint in joints]
        low = [*(joint.lower for joint in joints), *(-v for v in fastest)]
        high = [*(joint.upper for joint in joints), *fastest]
        self.limits: tuple[FloatArray, FloatArray] = (np.array(low), np.array(high))
        unit, total = ca.SX.sym("unit", len(joints)), Reaction(ca.SX(links.v.numel(), 1))
        for i, own in enumerate(rates):
            total += kinematics.reaction(unit[i] * own)
        columns = total.map(lambda part: ca.jacobian(part, unit))
        self.columns = links.generalized_force(kinematics, columns)
        forces = [joint.force(position[i], rate[i]) for i, joint in enumerate(joints)]
        self.force = ca.sparsify(ca.mtimes(self.columns, ca.vertcat(ca.SX(0, 1), *forces)))
        self.motors = self.columns[:, [i for i, j in enumerate(joints) if j.motor is not None]]
