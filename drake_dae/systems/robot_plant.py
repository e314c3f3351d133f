"""A RobotModel as a LeafSystem."""

from pydrake.systems.framework import BasicVector, Context

from drake_dae.arguments import checked
from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.block import Formula, TracedFormula
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

    A stage of actuation shows its state at ports of its own, which its class names: `motor_state`
    of `FlexibleJoints`, for example, or `motor_current` of `DcMotors`.

    `constraint_force` is lambda of (37), in N for contacts. With rigid joints it has direct
    feedthrough from `control`; with any stage it is a function of the state alone.

    Args:
        model: The robot.
        structure: The structure of `model.dae`; found if None.
        project: False leaves the drift off N* uncorrected, to study it.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self, model: RobotModel, *, structure: Structure | None = None, project: bool = True
    ) -> None:
        super().__init__(model.dae, structure=structure, project=project)
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
        if model.joint_force is not None:
            self._joint_force = model.dae.trace("joint torque", {"value": model.joint_force})
            self.DeclareVectorOutputPort(
                "joint_torque",
                model.joint_force.numel(),
                weakly(self._calc_joint_torque),
                state_tickets(self) | {self.all_parameters_ticket()},
            )

    def _calc_part(self, part: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.state(context)[part])

    def _calc_joint_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._joint_force(self.state(context), self.parameters(context))[0])

    def _formulas(self) -> dict[str, Formula]:
        state = self.dae.state
        formulas = super()._formulas()
        for name, part in self._parts.items():
            function = TracedFunction(name, {"state": state}, {"value": state[part]})
            formulas[name] = TracedFormula(function)
        if self.model.joint_force is not None:
            formulas["joint_torque"] = TracedFormula(self._joint_force)
        return formulas
