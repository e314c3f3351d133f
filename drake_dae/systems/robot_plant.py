"""A RobotModel as a LeafSystem."""

import casadi as ca
from pydrake.systems.framework import BasicVector, Context

from drake_dae.arguments import checked
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.errors import ModelError
from drake_dae.robots.contact.constraint_set import ConstraintSet
from drake_dae.robots.model import RobotModel
from drake_dae.systems.formulas import Formula, TracedFormula
from drake_dae.systems.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.trials import state_tickets
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class RobotPlant(DaePlant):
    """A constrained robot (37)-(40) with the ports of `DaePlant` and:

    Output ports:
        link_state: (q, v) of the links, shape (nq + nv,), as Drake's MultibodyPlant orders it.
        joint_torque: What the stages deliver to the joints, N m (N), shape (nu,); with any stage.
        constraint_wrenches: What each constraint does to each of its frames: 6 numbers, the moment
            in N m and the force in N as in Drake's SpatialForce, in the world, the force at the
            frame's origin. Frame B comes before A, and feels what the class of the constraint
            calls positive; A feels the opposite at the same point. Their power is zero where the
            constraint is ideal. `wrench_signals` tells the names,
            "<constraint>.<frame>.mx", ..., "<constraint>.<frame>.fz".
        loop_state: The coordinates of the joints that close loops, and then their rates, named by
            `model.loop_joints.signals`; if there are such joints.

    A stage of actuation shows its state at ports of its own, which its class names: `motor_state`
    of `FlexibleJoints`, for example, or `motor_current` of `DcMotors`.

    `constraint_force` is lambda of (37), in N for contacts. With rigid joints it has direct
    feedthrough from `control`; with any stage it is a function of the state alone.

    Args:
        model: The robot.
        structure: The structure of `model.dae`; found if None.
        project: False leaves the drift off N* uncorrected, to study it.
        feedback: Whether there is an input port `feedback`, as for `DaePlant`.

    Attributes:
        model: The robot.
        wrench_signals: Names and units of `constraint_wrenches`.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        model: RobotModel,
        *,
        structure: ConstraintStructure | None = None,
        project: bool = True,
        feedback: bool = False,
    ) -> None:
        super().__init__(model.dae, structure=structure, project=project, feedback=feedback)
        self.model = model
        size = model.links.q.numel() + model.links.v.numel()
        parts = {"link_state": slice(0, size)}
        start = size
        for stage in model.stages:
            for name, part in stage.ports.items():
                parts[name] = slice(start + part.start, start + part.stop)
            start += stage.state.numel()
        self._parts = parts
        for name, part in parts.items():
            self.DeclareVectorOutputPort(
                name,
                part.stop - part.start,
                weakly(self._calc_part, part),
                state_tickets(self),
            )
        self._add_wrenches()
        loops = model.loop_joints
        if loops.signals:
            self._loops = model.dae.trace("loop state", {"value": loops.state})
            self.functions["loop_state"] = self._loops
            size, calc = len(loops.signals), weakly(self._calc_loop_state)
            self.DeclareVectorOutputPort("loop_state", size, calc, self._by_state)
        if model.joint_force is not None:
            self._joint_force = model.dae.trace("joint torque", {"value": model.joint_force})
            self.DeclareVectorOutputPort(
                "joint_torque",
                model.joint_force.numel(),
                weakly(self._calc_joint_torque),
                self._by_state,
            )

    def _add_wrenches(self) -> None:
        model, dae = self.model, self.dae
        bound = ConstraintSet(model.constraints)
        force = ca.SX.sym("force", bound.size)
        wrenches, self.wrench_signals = bound.wrenches(model.links.kinematics(), force)
        inputs = {"state": dae.state, "force": force, "parameters": dae.parameter_symbol}
        self._wrenches = TracedFunction("constraint wrenches", inputs, {"value": wrenches})
        self._wrench_formula = wrenches, force
        tickets = self._by_control if self._force_needs_control else self._by_state
        size, calc = len(self.wrench_signals), weakly(self._calc_wrenches)
        self.DeclareVectorOutputPort("constraint_wrenches", size, calc, tickets)

    def _calc_wrenches(self, context: Context, output: BasicVector) -> None:
        force = self._evaluate(self._force, context, self._force_needs_control)
        state = context.get_continuous_state_vector().CopyToVector()
        values = self._wrenches.evaluate(state, force, self._values(context))[0]
        output.SetFromVector(values)

    def _calc_part(self, part: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.state(context)[part])

    def _calc_loop_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._loops(self.state(context), self._values(context))[0])

    def _calc_joint_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._joint_force(self.state(context), self._values(context))[0])

    def _formulas(self) -> dict[str, Formula]:
        state = self.dae.state
        formulas = super()._formulas()
        wrenches, force = self._wrench_formula
        derivatives = self.structure.derivatives
        constraint_input = derivatives.expand(derivatives.constraint_input)
        acting = ca.substitute(wrenches, force, self.dae.forces(constraint_input))
        formulas["constraint_wrenches"] = TracedFormula(
            self.structure.trace("constraint wrenches", acting, self._force_needs_control),
            signals=self._signals,
        )
        for name, part in self._parts.items():
            function = TracedFunction(name, {"state": state}, {"value": state[part]})
            formulas[name] = TracedFormula(function)
        if self.model.loop_joints.signals:
            formulas["loop_state"] = TracedFormula(self._loops)
        if self.model.joint_force is not None:
            formulas["joint_torque"] = TracedFormula(self._joint_force)
        return formulas
