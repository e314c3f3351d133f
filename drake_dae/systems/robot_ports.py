"""The ports that every plant of a RobotModel has beside those of its system."""

import casadi as ca
from pydrake.systems.framework import BasicVector, Context, DependencyTicket

from drake_dae.arrays import FloatArray
from drake_dae.dae.system import DaeSystem
from drake_dae.robots.contact.constraint_set import ConstraintSet
from drake_dae.robots.model import RobotModel
from drake_dae.systems.block import ParameterizedSystem
from drake_dae.systems.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.trials import state_tickets
from drake_dae.trace.functions import TracedFunction


class RobotPorts(ParameterizedSystem):
    """What a plant shows of a robot, from its state and its constraint force; see `RobotPlant`.

    A plant of this kind has x as its continuous state, and says what its constraint force is.

    Attributes:
        model: The robot.
        wrench_signals: Names and units of `constraint_wrenches`.
    """

    __slots__ = SHARED_DICTIONARY
    model: RobotModel

    def _shown_force(self, context: Context) -> FloatArray:
        """lambda, as the port `constraint_force` shows it, shape (m,)."""
        raise NotImplementedError

    def _declare_robot_ports(
        self, dae: DaeSystem, by_state: set[DependencyTicket], by_force: set[DependencyTicket]
    ) -> None:
        """Declares the ports.

        Args:
            dae: The robot's system, with all parameters that the block has.
            by_state: What a function of the state depends on.
            by_force: What the constraint force depends on.
        """
        model = self.model
        size = model.links.q.numel() + model.links.v.numel()
        parts, start = {"link_state": slice(0, size)}, size
        for stage in model.stages:
            for name, part in stage.ports.items():
                parts[name] = slice(start + part.start, start + part.stop)
            start += stage.state.numel()
        self._parts = parts
        for name, part in parts.items():
            calc = weakly(self._calc_part, part)
            self.DeclareVectorOutputPort(name, part.stop - part.start, calc, state_tickets(self))
        self._add_wrenches(dae, by_force)
        loops = model.loop_joints
        if loops.signals:
            self._loops = dae.trace("loop state", {"value": loops.state})
            size, calc = len(loops.signals), weakly(self._calc_loop_state)
            self.DeclareVectorOutputPort("loop_state", size, calc, by_state)
        if model.joint_force is not None:
            self._joint_force = dae.trace("joint torque", {"value": model.joint_force})
            size, calc = model.joint_force.numel(), weakly(self._calc_joint_torque)
            self.DeclareVectorOutputPort("joint_torque", size, calc, by_state)

    def _add_wrenches(self, dae: DaeSystem, by_force: set[DependencyTicket]) -> None:
        model, bound = self.model, ConstraintSet(self.model.constraints)
        force = ca.SX.sym("force", bound.size)
        wrenches, self.wrench_signals = bound.wrenches(model.links.kinematics(), force)
        inputs = {"state": dae.state, "force": force, "parameters": dae.parameter_symbol}
        self._wrenches = TracedFunction("constraint wrenches", inputs, {"value": wrenches})
        self._wrench_formula = wrenches, force
        size, calc = len(self.wrench_signals), weakly(self._calc_wrenches)
        self.DeclareVectorOutputPort("constraint_wrenches", size, calc, by_force)

    def _calc_wrenches(self, context: Context, output: BasicVector) -> None:
        force, state = self._shown_force(context), _state(context)
        output.SetFromVector(self._wrenches.evaluate(state, force, self._values(context))[0])

    def _calc_part(self, part: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(_state(context)[part])

    def _calc_loop_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._loops(_state(context), self._values(context))[0])

    def _calc_joint_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._joint_force(_state(context), self._values(context))[0])


def _state(context: Context) -> FloatArray:
    return context.get_continuous_state_vector().CopyToVector()
