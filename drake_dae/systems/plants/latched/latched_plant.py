"""Latches of Drake: constraints of a discrete MultibodyPlant that commands open and close."""

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import (
    CollisionFilterDeclaration,
    GeometrySet,
    Role,
    SceneGraph,
)
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.systems.plants.contact.contact_checks import check_same, other_masses, set_masses
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.plants.unilateral.contacts import UnilateralContacts


@checked(ModelError)
class LatchedPlant(LeafSystem, Plant):
    """A robot with latches in Drake: weld and ball constraints of a discrete MultibodyPlant.

    At t_n = n time_step it steps to t_(n+1) with the control, and with those latches active that
    are commanded to be closed at t_n. Drake's solver makes these constraints stiff: a load opens
    them by micrometers. Closing conserves momentum. Nothing of the robot collides.

    Drake has no port with the forces of its constraints. `constraint_force` is that of the step to
    t_n, by its momentum balance,

        M (v_n - v_(n-1)) / time_step = tau + B u + J^T lambda,

    with all terms on the right at t_(n-1), and lambda = 0 for open latches.

    Input ports:
        control: u, shape (p,).
        latch: Above 1/2 for each latch that is commanded to be closed, shape (l,).

    Output ports:
        state, link_state: x = (q, v), shape (n,).
        mode: 1 for each closed latch, 0 for open ones, shape (l,).
        gap: Empty: a latch has no free side.
        constraint_force: lambda, shape (m,).
        constraint_residual: phi_i, phi_i' of each constraint; zero for open latches.
        controlled_output: z.

    Args:
        model: The robot, with rigid joints; each constraint a latch.
        add_robot: Adds the robot to a plant, as it was added to the plant of the model.
        latches: The names of its constraints, in the order of `latch`.
        structure: A structure of the model's system.
        time_step: The step, in s.
        capture: The largest distance in m, or angle in rad, at which a latch closes.

    Attributes:
        dae, model, structure, time_step, latches: As for `Plant`.
        multibody: Drake's plant.

    Raises:
        ModelError: Drake does not have these constraints, or there are stages of actuation,
            exogenous signals or known forces.
        SimulationError: A latch is commanded to close too far from its place.
    """

    __slots__ = SHARED_DICTIONARY
    is_ideal = False

    def __init__(
        self,
        model: RobotModel,
        add_robot: Callable[[MultibodyPlant, SceneGraph], None],
        latches: Sequence[str],
        *,
        structure: ConstraintStructure,
        time_step: float = 1e-3,
        capture: float = 1e-3,
    ) -> None:
        super().__init__()
        self.time_step = positive(f"{model.name}: time_step", time_step)
        self._capture = positive(f"{model.name}: capture", capture)
        if model.stages or model.dae.exogenous or model.known_forces:
            raise ModelError(
                f"{model.name}: Drake's plant with latches takes no actuation, no exogenous "
                "signals and no known forces; use ideal constraints"
            )
        if sorted(latches) != sorted(constraint.name for constraint in model.constraints):
            raise ModelError(
                f"{model.name}: in Drake's plant with latches each constraint is a latch; these "
                f"are {', '.join(constraint.name for constraint in model.constraints)}"
            )
        self.model: RobotModel = model
        self.dae, self.structure = model.dae, structure
        self.latches = self.contacts = tuple(latches)
        self._contacts = UnilateralContacts(model, {}, latches)
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(time_step=time_step, use_sampled_output_ports=False)
        self.multibody, scene_graph = AddMultibodyPlant(config, builder)
        add_robot(self.multibody, scene_graph)
        by_name = {constraint.name: constraint for constraint in model.constraints}
        self._ids = [by_name[name].add_to(self.multibody) for name in latches]
        every = GeometrySet(scene_graph.model_inspector().GetAllGeometryIds(Role.kProximity))
        excluded = CollisionFilterDeclaration().ExcludeWithin(every)
        scene_graph.collision_filter_manager().Apply(excluded)
        self.multibody.Finalize()
        check_same(self.multibody, model)
        self._scene = builder.Build()
        # Scratch memory: all of it is set before each step.
        self._scratch = self._scene.CreateDefaultContext()
        masses = other_masses(model, self.multibody, model.dae.parameter_values)
        scratch = self._scene.GetMutableSubsystemContext(self.multibody, self._scratch)
        set_masses(scratch, masses)
        dae, force = model.dae, ca.SX.sym("force", model.dae.num_constraints)
        self._size = dae.num_states + dae.num_constraints
        held = self.DeclareDiscreteState(self._size + len(latches))
        self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, weakly(self._step))
        self.DeclareVectorInputPort("control", dae.num_controls)
        self.DeclareVectorInputPort("latch", len(latches))
        control = ca.SX.sym("control", dae.num_controls)
        self._terms = dae.trace(
            "momentum",
            {"mass": dae.mass_matrix, "free": dae.f + ca.mtimes(dae.h, control), "force": dae.g},
            {"control": control},
            often=False,
        )
        self._outputs = dae.trace("outputs", {"value": dae.outputs(force)}, {"force": force})
        self._residual = dae.trace("residual", {"value": self._contacts.residual})
        tickets = {self.discrete_state_ticket(held)}
        for name, size, value in (
            ("state", dae.num_states, self._state_of),
            ("link_state", dae.num_states, self._state_of),
            ("mode", len(latches), self._mode),
            ("gap", 0, self._no_gap),
            ("constraint_force", dae.num_constraints, self._force),
            ("constraint_residual", self._contacts.residual.numel(), self._held_residual),
            ("controlled_output", dae.num_outputs, self._output),
        ):
            self.DeclareVectorOutputPort(name, size, port_value(value), tickets)
        self.set_name(dae.name)

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        return {"mode": tuple(Signal(f"{name}.closed") for name in self.latches), "gap": ()}

    @property
    def port_signals(self) -> dict[str, tuple[Signal, ...]]:
        residual = self._contacts.residual_signals
        return {**super().port_signals, "constraint_residual": residual}

    def state(self, context: Context) -> FloatArray:
        return self._state_of(context).copy()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets the state x in a context, shape (n,), at rest without forces, all latches open.

        Raises:
            ModelError: The shape is wrong.
        """
        values = np.zeros(self._size + len(self.latches))
        values[: self.dae.num_states] = self.dae.state_vector(state)
        context.SetDiscreteState(values)

    def _state_of(self, context: Context) -> FloatArray:
        return context.get_discrete_state_vector().value()[: self.dae.num_states]

    def _force(self, context: Context) -> FloatArray:
        return context.get_discrete_state_vector().value()[self.dae.num_states : self._size]

    def _mode(self, context: Context) -> FloatArray:
        return context.get_discrete_state_vector().value()[self._size :]

    def _no_gap(self, context: Context) -> FloatArray:
        return np.zeros(0)

    def _held_residual(self, context: Context) -> FloatArray:
        (values,) = self._residual(self._state_of(context), self.dae.parameter_values)
        return values * self._contacts.holds((self._mode(context) > 0.5).tolist())

    def _output(self, context: Context) -> FloatArray:
        values = self.dae.parameter_values
        return self._outputs.evaluate(self._state_of(context), self._force(context), values)[0]

    def _step(self, context: Context, values: DiscreteValues) -> EventStatus:
        x, mode = self._state_of(context), self._mode(context)
        control = self.GetInputPort("control").Eval(context)
        latched = self.GetInputPort("latch").Eval(context) > 0.5
        for place in np.flatnonzero(latched & (mode < 0.5)):
            self._contacts.check_capture(
                int(place), context.get_time(), x, self.dae.parameter_values, self._capture
            )
        plant = self.multibody
        scratch = self._scene.GetMutableSubsystemContext(plant, self._scratch)
        plant.SetPositionsAndVelocities(scratch, x)
        for key, closed in zip(self._ids, latched, strict=True):
            plant.SetConstraintActiveStatus(scratch, key, bool(closed))
        plant.get_actuation_input_port().FixValue(scratch, control)
        after = plant.EvalUniquePeriodicDiscreteUpdate(scratch).value()
        force = self._balanced(x, after, control, latched)
        values.set_value(np.concatenate([after, force, latched]))
        return EventStatus.Succeeded()

    def _balanced(
        self, before: FloatArray, after: FloatArray, control: FloatArray, latched: FloatArray
    ) -> FloatArray:
        """The constraint forces of a step by its momentum balance, shape (m,)."""
        mass, free, force = self._terms.evaluate(before, control, self.dae.parameter_values)
        n, first = before.size, self.model.links.q.numel()
        moved = slice(first, n)
        change = (after[moved] - before[moved]) / self.time_step
        left = mass.reshape(n, n)[moved, moved] @ change - free[moved]
        rows = np.concatenate(
            [[], *(r for r, shut in zip(self._contacts.latch_rows, latched, strict=True) if shut)]
        ).astype(int)
        forces = np.zeros(self.dae.num_constraints)
        columns = force.reshape(n, -1)[moved][:, rows]
        forces[rows] = np.linalg.lstsq(columns, left, rcond=None)[0]
        return forces
