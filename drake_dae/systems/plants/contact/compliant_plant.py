"""A robot in compliant point contact, as Drake computes it, as traced equations."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import Block, Held, Requirement
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import ConstraintStructure, Signal, constraint_structure_of
from drake_dae.errors import ModelError
from drake_dae.robots import RobotModel
from drake_dae.systems.parameterized import ParameterizedSystem
from drake_dae.systems.plants.contact.compliance import OUTSIDE, CompliantEquations
from drake_dae.systems.plants.contact.contact_checks import changed_parameters
from drake_dae.systems.plants.contact.contact_forces import contact_force_signals
from drake_dae.systems.plants.contact.contact_material import FRICTION, PointMaterial
from drake_dae.systems.plants.contact.stage_steps import check_step
from drake_dae.systems.plants.contract import Plant
from drake_dae.trace.functions import FailureKind


@checked(ModelError)
class CompliantPlant(ParameterizedSystem, Plant):
    """A robot whose contacts are compliant, by Drake's equations of point contact.

    Unlike those of a `ContactPlant` its surfaces may have any shape and move. Each `PointOnSurface`
    touches with a ball; nothing else of the robot collides.

    With `time_step` > 0 it is discrete: at t_n = n time_step, with the control of that instant,

        A (v_+ - v*) = J^T gamma,    v* = v + h A^-1 (tau - H),    q_+ = q + h N(q) v_+,

    A = M + h D with the damping D of the joints, and the impulses gamma of `contact_step`: Drake's
    discrete MultibodyPlant with its default, the "lagged" approximation. Stages of actuation step
    as `stages_after`. With `time_step` = 0 it is continuous,

        M v' + H = tau + J^T F,

    with the forces F of `contact_force`, those of a continuous MultibodyPlant. Torques beyond the
    effort limits are cut to them, as Drake does; a joint that reaches its limit ends the run.

    Input ports:
        control: u, shape (p,).
        exogenous: The signals w with their derivatives, if there are any.

    Output ports:
        state, link_state, joint_torque, and the ports of the stages: as for `RobotPlant`.
        contact_force: F of each contact on the robot, N, shape (3 m,), with friction, in the world.
        constraint_force: lambda = n(q) . F, N, shape (m,).
        constraint_residual: phi and phi', as for `DaePlant`; not zero in compliant contact.
        controlled_output: z = l(x) + m(x) lambda.

    Args:
        model: The robot; each constraint a `PointOnSurface`.
        material: The contact material.
        structure: The structure of the model's system; found if None.
        parameters: Parameter name -> the default of the plant; that of the model if left out.

    Raises:
        ModelError: A constraint is no contact of a point with a surface, a ball does not fit its
            surface, or the step is too long for the stages.
        SimulationError: A joint reaches its limit in a run, or a step has no solution.
    """

    __slots__ = SHARED_DICTIONARY
    is_ideal = False

    def __init__(
        self,
        model: RobotModel,
        material: PointMaterial,
        *,
        structure: ConstraintStructure | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        dae = model.dae
        structure = constraint_structure_of(type(self).__name__, dae, structure)
        values = dae.parameter_vector(changed_parameters(model, parameters or {}))
        self.model: RobotModel = model
        self.time_step, self._stepped = material.time_step, np.zeros(0)
        self._check_step(values)
        self.structure, self.material = structure, material
        equations = CompliantEquations(model, structure, material)
        self._place = equations.own_parameters
        block = compliant_block(model, equations, structure, material, values)
        super().__init__(dae, block)

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        return {"contact_force": self.contact_force_signals}

    @property
    def further_parameters(self) -> Mapping[str, tuple[Signal, int]]:
        first = self.dae.parameter_symbol.numel()
        return {
            signal.name: (signal, first + place)
            for place, signal in enumerate(self.material.signals)
            if signal is not FRICTION or self.material.friction is not None
        }

    def friction(self, context: Context) -> dict[str, float]:
        if FRICTION.name not in self.further_parameters:
            return super().friction(context)
        place = self.further_parameters[FRICTION.name][1]
        value = float(context.get_numeric_parameter(0).GetAtIndex(place))
        return {constraint.name: value for constraint in self.robot("friction").constraints}

    def state(self, context: Context) -> FloatArray:
        if not self.time_step:
            return super().state(context)
        self.check_context(context)
        return context.get_discrete_state(0).CopyToVector()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets x as given, shape (n,), in contact or not.

        Raises:
            ModelError: The shape is wrong.
        """
        if not self.time_step:
            super().set_state(context, state)
            return
        self.check_context(context)
        context.SetDiscreteState(0, self.dae.state_vector(state))
        context.SetDiscreteState(1, np.zeros(len(self.contact_force_signals)))

    @checked(ModelError)
    def set_contact(self, context: Context, material: PointMaterial) -> None:
        """Sets stiffness, dissipation, friction and radius, and places the balls on the robot.

        In the nominal configuration, with the parameters of the context, a ball touches at the
        point of its constraint.

        Args:
            context: The context of the plant.
            material: The material, with the time_step and stiction_tolerance of the plant,
                and a friction if and only if that of the plant has one.

        Raises:
            ModelError: The material does not fit the plant, a ball its surface, or the step the
                stages with the parameters of the context.
        """
        fixed, others = (
            (given.time_step, given.stiction_tolerance, given.friction is None)
            for given in (self.material, material)
        )
        if fixed != others:
            raise ModelError(
                f"{self.dae.name}: the plant was made with {self.material}; only its stiffness, "
                f"dissipation, radius and a number of its friction may change, got {material}"
            )
        values = context.get_numeric_parameter(0).CopyToVector()
        values = values[: self.dae.parameter_symbol.numel()]
        self._check_step(values)
        placed = self._place(values, material)
        context.get_mutable_numeric_parameter(0).SetFromVector(placed)

    def _check_step(self, values: FloatArray) -> None:
        """Refuses a step that is too long for the stages; see `check_step`."""
        if self.model.stages and self.time_step and not np.array_equal(values, self._stepped):
            check_step(self.model, self.time_step, values)
            self._stepped = values.copy()

    @property
    def contact_force_signals(self) -> Sequence[Signal]:
        """Names and units of `contact_force`."""
        return self.block.signals["contact_force"]


def compliant_block(
    model: RobotModel,
    equations: CompliantEquations,
    structure: ConstraintStructure,
    material: PointMaterial,
    values: FloatArray,
) -> Block:
    """The block of a robot in compliant contact, continuous or discrete; see `CompliantPlant`."""
    dae, forces = model.dae, contact_force_signals(model)
    fits = Requirement(equations.slack, OUTSIDE, FailureKind.OUTSIDE)
    state, advanced = structure.manifold.project(dae.nominal_state), fits.of(equations.advanced)
    block = Block(
        dae.name,
        inputs={"control": equations.control},
        outputs=equations.outputs,
        parameters=equations.parameters,
        start={"state": state, "parameters": equations.own_parameters(values, material)},
        requirements=(fits,),
        signals={
            "state": dae.state_signals,
            "control": dae.control_signals,
            "constraint_force": dae.force_signals,
            "constraint_residual": structure.manifold.residual_signals,
            "controlled_output": dae.output_signals,
            "contact_force": forces,
            "parameters": [*dae.parameter_signals, *material.signals],
        },
    )
    if not material.time_step:
        return replace(block, state=dae.state, derivative=advanced, scale=dae.scale)
    n, rate = dae.num_states, material.time_step
    held = {
        "state": Held(dae.state, advanced[:n, 0], state, rate),
        "contact_force": Held(equations.force, advanced[n:, 0], np.zeros(len(forces)), rate),
    }
    return replace(block, held=held)
