"""The ports of a plant of a RobotModel besides those of its system."""

from collections.abc import Callable, Sequence

import casadi as ca
from pydrake.systems.framework import Context, DependencyTicket, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.blocks.lifetime import port_value
from drake_dae.blocks.trials import state_tickets
from drake_dae.dae.system.signals import Signal
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction


class RobotPorts:
    """The output ports of a robot's plant, from state and constraint force; see `RobotPlant`.

    Not a base class of the plant, since a Python class can have only one base of Drake.

    Args:
        plant: The plant, with x as its continuous state, which gets the ports.
        model: The robot.
        values: A function of a context with all parameters; it must not keep the plant alive.
        force: A function of a context with lambda of the port `constraint_force`; likewise.
        by_state: The dependencies of a function of the state.
        by_force: The dependencies of the constraint force.

    Attributes:
        parts: Name of a port -> its part of the state.
        wrench_signals: Names and units of `constraint_wrenches`.
        wrenches, force: That port as expressions, and the symbols of lambda in it.
        loop_signals: Names and units of `loop_state` under that name; empty without it.
        wrench_function: The same as a function of state, lambda and parameters.
        joints: `loop_state` and `joint_torque` as functions of state and parameters, as far as the
            robot has them.
    """

    def __init__(
        self,
        plant: LeafSystem,
        model: RobotModel,
        values: Callable[[Context], FloatArray],
        force: Callable[[Context], FloatArray],
        by_state: set[DependencyTicket],
        by_force: set[DependencyTicket],
    ) -> None:
        dae, self._values, self._force = model.dae, values, force
        size = model.links.q.numel() + model.links.v.numel()
        self.parts = {"link_state": slice(0, size), **stage_ports(model, size)}
        for name, part in self.parts.items():
            calc = port_value(self._part, part)
            plant.DeclareVectorOutputPort(name, part.stop - part.start, calc, state_tickets(plant))

        bound = ConstraintSet(model.constraints)
        self.force = ca.SX.sym("force", bound.size)
        self.wrenches, self.wrench_signals = bound.wrenches(model.links.kinematics(), self.force)
        inputs = {"state": dae.state, "force": self.force, "parameters": dae.parameter_symbol}
        self.wrench_function = TracedFunction(
            "constraint wrenches", inputs, {"value": self.wrenches}
        )
        size, calc = len(self.wrench_signals), port_value(self._wrenches)
        plant.DeclareVectorOutputPort("constraint_wrenches", size, calc, by_force)

        self.joints: dict[str, TracedFunction] = {}
        self.loop_signals: dict[str, Sequence[Signal]] = {}
        if model.loop_joints.signals:
            self.loop_signals = {"loop_state": model.loop_joints.signals}
            self.joints["loop_state"] = dae.trace("loop state", {"value": model.loop_joints.state})
        if model.joint_force is not None:
            self.joints["joint_torque"] = dae.trace("joint torque", {"value": model.joint_force})
        for name, function in self.joints.items():
            size, calc = function.outputs[0].size, port_value(self._value, function)
            plant.DeclareVectorOutputPort(name, size, calc, by_state)

    def _wrenches(self, context: Context) -> FloatArray:
        force, state = self._force(context), _state(context)
        return self.wrench_function.evaluate(state, force, self._values(context))[0]

    def _part(self, part: slice, context: Context) -> FloatArray:
        return _state(context)[part]

    def _value(self, function: TracedFunction, context: Context) -> FloatArray:
        return function(_state(context), self._values(context))[0]


def stage_ports(model: RobotModel, start: int = 0) -> dict[str, slice]:
    """Name of a port of a robot's stages -> its part of (..., s), where s begins at `start`."""
    parts = {}
    for stage in model.stages:
        for name, part in stage.ports.items():
            parts[name] = slice(start + part.start, start + part.stop)
        start += stage.state.numel()
    return parts


def _state(context: Context) -> FloatArray:
    return context.get_continuous_state_vector().CopyToVector()
