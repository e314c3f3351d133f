"""The ports of a plant of a RobotModel besides those of its system."""

from collections.abc import Callable, Sequence

import casadi as ca
from pydrake.systems.framework import BasicVector, Context, DependencyTicket, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.lifetime import weakly
from drake_dae.systems.blocks.trials import state_tickets
from drake_dae.trace.functions import TracedFunction


class RobotPorts:
    """The output ports of a robot's plant, from state and constraint force; see `RobotPlant`.

    Not a base class of the plant, since a Python class can have only one base of Drake.

    Args:
        plant: The plant, with x as its continuous state; gets the ports, and keeps this.
        model: The robot.
        dae: The robot's system.
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
        loops, joint_force: The functions of the ports `loop_state` and `joint_torque`; None without
            them.
    """

    def __init__(
        self,
        plant: LeafSystem,
        model: RobotModel,
        dae: DaeSystem,
        values: Callable[[Context], FloatArray],
        force: Callable[[Context], FloatArray],
        by_state: set[DependencyTicket],
        by_force: set[DependencyTicket],
    ) -> None:
        self._values, self._force = values, force
        size = model.links.q.numel() + model.links.v.numel()
        self.parts, start = {"link_state": slice(0, size)}, size
        for stage in model.stages:
            for name, part in stage.ports.items():
                self.parts[name] = slice(start + part.start, start + part.stop)
            start += stage.state.numel()
        for name, part in self.parts.items():
            calc = weakly(self._calc_part, part)
            plant.DeclareVectorOutputPort(name, part.stop - part.start, calc, state_tickets(plant))

        bound = ConstraintSet(model.constraints)
        self.force = ca.SX.sym("force", bound.size)
        self.wrenches, self.wrench_signals = bound.wrenches(model.links.kinematics(), self.force)
        inputs = {"state": dae.state, "force": self.force, "parameters": dae.parameter_symbol}
        self.wrench_function = TracedFunction(
            "constraint wrenches", inputs, {"value": self.wrenches}
        )
        size, calc = len(self.wrench_signals), weakly(self._calc_wrenches)
        plant.DeclareVectorOutputPort("constraint_wrenches", size, calc, by_force)

        self.loops = self.joint_force = None
        self.loop_signals: dict[str, Sequence[Signal]] = {}
        if model.loop_joints.signals:
            self.loop_signals = {"loop_state": model.loop_joints.signals}
            self.loops = dae.trace("loop state", {"value": model.loop_joints.state})
            size, calc = len(model.loop_joints.signals), weakly(self._calc_of, self.loops)
            plant.DeclareVectorOutputPort("loop_state", size, calc, by_state)
        if model.joint_force is not None:
            self.joint_force = dae.trace("joint torque", {"value": model.joint_force})
            size, calc = model.joint_force.numel(), weakly(self._calc_of, self.joint_force)
            plant.DeclareVectorOutputPort("joint_torque", size, calc, by_state)

    def _calc_wrenches(self, context: Context, output: BasicVector) -> None:
        force, state = self._force(context), _state(context)
        output.SetFromVector(self.wrench_function.evaluate(state, force, self._values(context))[0])

    def _calc_part(self, part: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(_state(context)[part])

    def _calc_of(self, function: TracedFunction, context: Context, output: BasicVector) -> None:
        output.SetFromVector(function(_state(context), self._values(context))[0])


def _state(context: Context) -> FloatArray:
    return context.get_continuous_state_vector().CopyToVector()
