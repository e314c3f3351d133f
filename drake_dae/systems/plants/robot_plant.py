"""A RobotModel as a LeafSystem."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.blocks.computations import PARAMETERS, STATE, Block, Computation
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.formulas import Formula, TracedFormula
from drake_dae.systems.plants.dae_plant import DaePlant
from drake_dae.systems.plants.robot_ports import RobotPorts
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class RobotPlant(DaePlant):
    """A constrained robot (37)-(40) with the ports of `DaePlant` and:

    Output ports:
        link_state: (q, v) of the links, shape (nq + nv,), as Drake's MultibodyPlant orders it.
        joint_torque: The torques or forces of the stages on the joints, N m (N), shape (nu,); with
            any stage.
        constraint_wrenches: The wrench of each constraint on each of its frames: 6 numbers, the
            moment in N m and the force in N as in Drake's SpatialForce, in the world, the force at
            the frame's origin. Frame B comes before A; the positive direction is that of the
            constraint's class, and A gets the opposite at the same point. The total power of an
            ideal constraint is zero. `wrench_signals` has the names, "<constraint>.<frame>.mx",
            ..., "<constraint>.<frame>.fz".
        loop_state: The coordinates of the joints that close loops, and then their rates, named by
            `model.loop_joints.signals`; if there are such joints.

    A stage of actuation has further ports with its state, see its class: `motor_state` of
    `FlexibleJoints`, for example, or `motor_current` of `DcMotors`.

    `constraint_force` is lambda of (37), in N for contacts. With rigid joints it has direct
    feedthrough from `control`; with any stage it is a function of the state alone.

    Args:
        model: The robot.
        structure: The structure of `model.dae`; found if None.
        project: False leaves the drift off N* uncorrected, to study it.

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
    ) -> None:
        super().__init__(model.dae, structure=structure, project=project)
        self.model: RobotModel = model
        values, force = weakly(self._values), weakly(self._evaluate, self._force)
        by_force = self._tickets(self._force)
        self._ports = RobotPorts(self, model, values, force, self._by_state, by_force)
        self.wrench_signals = self._ports.wrench_signals
        if "loop_state" in self._ports.joints:
            self.functions["loop_state"] = self._ports.joints["loop_state"]

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        return self._ports.loop_signals

    def _formulas(self) -> dict[str, Formula]:
        state = self.dae.state
        formulas = super()._formulas()
        ports = self._ports
        derivatives = self.structure.derivatives
        constraint_input = derivatives.expand(derivatives.constraint_input)
        wrenches = ca.substitute(ports.wrenches, ports.force, self.dae.forces(constraint_input))
        takes_control = "control" in self._force.input_names
        formulas["constraint_wrenches"] = TracedFormula(
            self.structure.trace("constraint wrenches", wrenches, takes_control),
            signals=self._signals,
        )
        for name, part in ports.parts.items():
            function = TracedFunction(name, {"state": state}, {"value": state[part]})
            formulas[name] = TracedFormula(function)
        formulas |= {name: TracedFormula(function) for name, function in ports.joints.items()}
        return formulas

    def traced(self) -> Block:
        block, ports, state = super().traced(), self._ports, self.dae.state
        computations = [
            Computation(ca.Function("part", [state], [state[part]]), (STATE,), (name,))
            for name, part in ports.parts.items()
        ]
        sources = (STATE, "constraint_force", PARAMETERS)
        computations.append(
            Computation.of(ports.wrench_function, sources, ("constraint_wrenches",))
        )
        computations += [
            Computation.of(function, (STATE, PARAMETERS), (name,))
            for name, function in ports.joints.items()
        ]
        return replace(block, computations=(*block.computations, *computations))
