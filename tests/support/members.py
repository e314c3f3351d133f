"""Members of families that the package does not know: one class each.

They show what it takes to add one, and keep the contracts as those of the package do.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from pydrake.systems.framework import BasicVector, LeafSystem

from drake_dae import ForceOutput
from drake_dae.dae import Signal
from drake_dae.robots import AttachedStage, Constraint, Stage, Surface, diagonal_parameter
from drake_dae.systems import Controller, Plant
from drake_dae.systems.phases import Condition, Phase


@dataclass(frozen=True)
class Mirror(Constraint):
    """Two angles turn against each other, q_i + q_j = sum; its moment acts at no known frame."""

    first: int
    second: int
    sum: float
    name: str = "mirror"

    @property
    def force_signals(self):
        return (Signal(f"{self.name}.moment", "N m"),)

    @property
    def residual_signals(self):
        return (Signal(f"{self.name}.slip", "rad"),)

    def residual(self, frames):
        return frames.q[self.first] + frames.q[self.second] - self.sum

    def applications(self, kinematics):
        return ()


@dataclass(frozen=True)
class Saddle(Surface):
    """z = bend (x^2 - y^2) above a point; the free side is above."""

    point: tuple
    bend: float

    @property
    def position(self):
        return self.point

    def distance(self, offset):
        x, y, z = ca.vertsplit(offset)
        slope = 2.0 * self.bend * ca.sqrt(x**2 + y**2)
        return (z - self.bend * (x**2 - y**2)) / ca.sqrt(1.0 + slope**2)


@dataclass(frozen=True, eq=False)
class TorqueLag(Stage):
    """Drives whose torque follows the control with a lag: T tau' = u - tau."""

    time_constant: float | np.ndarray

    def attach(self, links):
        count = len(links.actuator_signals)
        parameter, T = diagonal_parameter(
            "torque_lag.time_constant", self.time_constant, count, "s", positive=True
        )
        torque = ca.SX.sym("tau", count)
        return AttachedStage(
            state=torque,
            state_signals=tuple(Signal(f"{s.name}.torque", s.unit) for s in links.actuator_signals),
            mass=ca.diag(T),
            drift=lambda position, velocity: -torque,
            drive_matrix=ca.SX.eye(count),
            drive_signals=tuple(links.actuator_signals),
            force=lambda position, velocity: torque,
            parameters=(parameter,),
            ports={"lagged_torque": slice(0, count)},
        )


class SpringyPlant(LeafSystem, Plant):
    """A robot whose constraints spring back where it has left them, instead of a projection:

        k'' + 2 a k' + a^2 k = 0    for each constraint k of degree 2 (Baumgarte 1972).

    With v_0 the force that keeps k'' = 0, that is v = v_0 - A^-1 (2 a k' + a^2 k). Its numbers are
    fixed, nothing moves, and all of it is logged.
    """

    __slots__ = ()

    def __init__(self, model, structure):
        super().__init__()
        rate = 40.0
        self.model, self.dae, self.structure = model, model.dae, structure
        dae, derivatives = model.dae, structure.derivatives
        control = derivatives.control
        exact = derivatives.expand(derivatives.constraint_input)
        residual = structure.manifold.residual_expression
        back = 2.0 * rate * residual[1::2] + rate**2 * residual[0::2]
        change = -ca.solve(structure.elimination.constraint_matrix, back)
        moved = ca.solve(ca.densify(dae.mass_matrix), ca.mtimes(dae.g, change))
        force = exact + change
        links = model.links.q.numel() + model.links.v.numel()
        expressions = {
            "rate": derivatives.expand(derivatives.rate) + moved,
            "constraint_force": dae.forces(force),
            "controlled_output": dae.l + ca.mtimes(dae.m, force),
            "state": dae.state,
            "link_state": dae.state[:links],
            "constraint_residual": residual,
        }
        traced = {n: dae.trace(n, {n: e}, {"control": control}) for n, e in expressions.items()}
        self._rate = traced.pop("rate")

        self.set_name(dae.name)
        self.DeclareContinuousState(BasicVector(structure.manifold.project(dae.nominal_state)))
        self._control = self.DeclareVectorInputPort("control", dae.num_controls)
        for name, function in traced.items():
            steered = name in ("constraint_force", "controlled_output")
            self.DeclareVectorOutputPort(
                name,
                expressions[name].numel(),
                lambda c, out, f=function, s=steered: out.SetFromVector(self._value(f, c, s)),
                {self.all_sources_ticket() if steered else self.xc_ticket()},
            )

    def _value(self, function, context, steered=True):
        control = self._control.Eval(context) if steered else np.zeros(self.dae.num_controls)
        return function(self.state(context), control, self.dae.parameter_values)[0]

    def DoCalcTimeDerivatives(self, context, derivatives):
        derivatives.SetFromVector(self._value(self._rate, context))


class RestingController(LeafSystem, Controller):
    """Holds a robot where a run begins: the law with references that stand still there."""

    __slots__ = ()

    def __init__(self, law):
        super().__init__()
        self.law, dae = law, law.system
        self.set_name("resting")
        self._goal = np.zeros(law.layout.reference_size)
        self._goal[law.layout.lowest] = [0.3, 20.0]
        self._state = self.DeclareVectorInputPort("estimated_state", dae.num_states)
        self.DeclareVectorOutputPort("control", dae.num_controls, self._calc)

    def _calc(self, context, output):
        given = self._state.Eval(context), self._goal, self.law.all_parameters()
        output.SetFromVector(self.law.function(*given)[0])

    def derived(self, values):
        signals, outputs = self.law.system.output_signals, values["controlled_output"]
        desired = np.tile(self._goal[self.law.layout.lowest], (len(outputs), 1))
        return {
            "desired_output": (desired, signals),
            "tracking_error": (outputs - desired, signals),
        }

    def predicted_error(self, times, values, parameters):
        return self.law.predicted_error(times - times[0], values["state"][0], self._goal)


def subclasses(family):
    """Every class of a family that the package has and that can be made."""
    found, waiting = set(), [family]
    while waiting:
        for cls in waiting.pop().__subclasses__():
            waiting.append(cls)
            if cls.__module__.startswith("drake_dae") and not cls.__abstractmethods__:
                found.add(cls)
    return found


@dataclass(frozen=True)
class Pull(ForceOutput):
    """What a constraint exerts on a frame along an axis of that frame, a unit vector."""

    frame: str
    constraint: str
    axis: tuple[float, float, float]

    def expression(self, constraints, kinematics, constraint_force):
        _, force = constraints.force_on(self.frame, self.constraint, kinematics, constraint_force)
        return ca.dot(ca.mtimes(kinematics.rotation(self.frame), ca.DM(self.axis)), force)

    def signals(self, constraints):
        return (Signal(f"{self.constraint}.pull", "N"),)


@dataclass(frozen=True)
class Rise(Phase):
    """The tool goes up at a constant speed for some time, of a robot with the output "tool.z"."""

    duration: float
    speed: float = 0.05
    begins_in_contact, ends_in_contact = False, False

    def rates(self, contact_output):
        return {"tool.z": self.speed}

    def ends(self, contact_force):
        return [Condition("time", above=self.duration)]
