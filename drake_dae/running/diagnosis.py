"""Why a run ended: one diagnosis for all ends, and stiffness while it runs."""

import warnings
from collections.abc import Callable, Iterator, Sequence

import casadi as ca
import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray, show_state
from drake_dae.blocks.failures import cannot_go_on, singular_configuration
from drake_dae.dae import ConstraintStructure, EndCause, Signal, Structure, ZeroDynamics
from drake_dae.diagrams.record import Recorded, computed_record
from drake_dae.errors import (
    DrakeDaeError,
    PainleveError,
    SimulationError,
    SingularityError,
    WiringError,
)
from drake_dae.running.divergence import DivergenceWatch
from drake_dae.systems.applied_control import ControlLimits
from drake_dae.systems.controller import Controller
from drake_dae.systems.plant import Plant
from drake_dae.systems.references import ReferenceGenerator
from drake_dae.trace.numerics import equilibration, smallest_singular_value

# The smallest singular value of A(x) or B(x), rows and columns scaled by their usual sizes, below
# which it is why a run ends: steps become too short long before it is zero. NEARLY is the same at
# the last state that is found along a path that ends.
SINGULAR, NEARLY = 1e-3, 0.05
OFF = 0.1  # The distance from N*, in units of the states, up to which A(x) is judged.
PART = 0.3  # The share of the largest part in a singular direction from which an output is named.
# The times at which a reference is followed to the end of a run, and beyond it as a share.
PLACES, BEYOND = 60, 0.02
IMPLICIT = ("implicit", "velocity_implicit", "radau")  # Stiffness does not limit their steps.
# The product of step and rate from which explicit steps may grow: of the third order on the
# imaginary axis, where elastic joints are.
LONGEST = 1.7
# A run is looked at each so many steps; below this share of the longest mean they collapsed.
EVERY, COLLAPSED = 32, 1e-5
# The steps after which the pace of a run is examined, and those from which a run counts as long.
PACE, MANY = 2000, 100_000

IN_SIMULATE = "Choose integration_scheme 'radau3' or 'implicit_euler', or a slower model"
IN_ROLLOUT = "Run it by simulate with integration_scheme 'radau3', or choose a slower model"


def explained(
    error: SimulationError,
    plant: Plant,
    structure: Structure | None = None,
    reference: Callable[[float], FloatArray] | None = None,
    start: tuple[float, FloatArray] | None = None,
) -> SimulationError:
    """The error of a run with its cause: A(x) or B(x) is singular, or a path leaves its reach."""
    name, state, own = plant.dae.name, error.state, getattr(plant, "structure", None)
    if isinstance(error, PainleveError) or (
        isinstance(error, SingularityError) and error.constraints
    ):
        return error
    if state.size != plant.dae.num_states or not np.isfinite(state).all():
        state = np.zeros(0)
    if state.size and plant.is_ideal and isinstance(own, ConstraintStructure):
        # Farther off N* than a few steps lead A(x) says nothing.
        manifold, values = own.manifold, plant.dae.parameter_values
        usual = np.linalg.norm(manifold.gradients(own.states[0]) * own.scale, axis=1)
        is_near = np.all(np.abs(manifold.residual(state, values)) <= OFF * usual)
        if is_near and _margin(own, own.elimination.constraint_matrix, state)[0] < SINGULAR:
            names = own.dependent_constraints(state, values)
            return singular_configuration(name, error.time, state, names)
    if structure is None:
        return error
    system, ending, limit = structure.system, None, SINGULAR
    if reference is not None and start is not None and not system.exogenous.moving:
        begin, lasted = start[0], error.time - start[0]
        times = np.linspace(begin, error.time + BEYOND * lasted, PLACES)
        try:
            zero = ZeroDynamics(system, structure=structure)
            ending = zero.motion(reference, times, start[1]).ending if lasted > 0.0 else None
        except DrakeDaeError:
            pass
        told_of = (EndCause.OUT_OF_REACH, EndCause.SINGULAR, EndCause.NO_WAY_ON)
        ending = ending if ending is not None and ending.cause in told_of else None
    if ending is not None and ending.state is not None and ending.matrix:
        # Singular where the path ends, and nearly so where the run did.
        state, limit = ending.state, NEARLY
    outputs, constraints = tuple[str, ...](), tuple[str, ...]()
    if state.size == system.num_states:
        signals = system.output_signals
        outputs = _dependent(structure, structure.control_matrix, signals, state, limit)
        signals = (*system.constraint_output_signals, *signals)
        gradients = ca.jacobian(ca.vertcat(system.k, system.l), system.state)
        names = _dependent(structure, gradients, signals, state, limit) if outputs else ()
        constraints = tuple(s.name for s in system.constraint_output_signals if s.name in names)
    if not outputs and ending is None:
        return error
    told = f"{name}: B(x) of Assumption (5) is singular at t = {error.time:.6g} s, state "
    told = f"{told}{show_state(state)}" if ending is None else str(ending)
    if outputs:
        held = f" beside {', '.join(constraints)}" if constraints else ""
        told = f"{told}. There the drives cannot steer {', '.join(outputs)}{held}"
    told = (
        f"{told}. Keep the reference away from there, or choose another posture or other outputs. "
        f"The run ended at t = {error.time:.6g} s, state {show_state(error.state)}"
    )
    if not outputs and not (ending is not None and ending.matrix):
        return SimulationError(told, error.time, error.state)
    singular = SingularityError(told, error.time, error.state)
    singular.constraints = constraints
    return singular


def _dependent(
    structure: Structure, matrix: ca.SX, signals: Sequence[Signal], state: FloatArray, limit: float
) -> tuple[str, ...]:
    """The signals whose rows in a matrix depend on each other at a state, but for rows of 0."""
    rows = [i for i in range(matrix.rows()) if matrix[i, :].nnz()]
    margin, part = _margin(structure, matrix[rows, :], state)
    if not margin < limit:
        return ()
    return tuple(signals[rows[i]].name for i in np.flatnonzero(part > PART * part.max()))


def _margin(
    structure: ConstraintStructure, matrix: ca.SX, state: FloatArray
) -> tuple[float, FloatArray]:
    """The smallest singular value of a scaled matrix, and the parts of its rows in it."""
    if not matrix.numel():
        return np.inf, np.zeros(0)
    function = structure.system.trace("margin", {"matrix": matrix}, often=False)

    def at(x: FloatArray) -> FloatArray:
        return function(x, structure.system.parameter_values)[0].reshape(matrix.shape).copy()

    rows, columns = equilibration(np.mean([np.abs(at(x)) for x in structure.states], axis=0))
    value = at(state) / rows[:, None] / columns
    if not np.isfinite(value).all():
        return 0.0, np.ones(len(rows))
    return smallest_singular_value(value), np.abs(np.linalg.svd(value)[0][:, -1])


def _blocks_of(system: System) -> Iterator[System]:
    """The blocks of a diagram; a plant or a controller that is a diagram is one block."""
    if isinstance(system, Diagram) and not isinstance(system, Plant | Controller):
        for block in system.GetSystems():
            yield from _blocks_of(block)
    else:
        yield system


# Name of a signal -> its present values, with their names and units.
_Rows = dict[str, tuple[FloatArray, Sequence[Signal]]]


class RunWatch:
    """Looks at a simulation: does it diverge, stop, or take very many steps, and why did it end.

    The errors of a `Controller` are looked at if there is exactly one `Plant`.
    """

    def __init__(
        self, diagram: System, context: Context, config: SimulatorConfig, duration: float
    ) -> None:
        self._diagram, self._config, self._time = diagram, config, context.get_time()
        self._duration, self._blocks = duration, list(_blocks_of(diagram))
        self._plants = [block for block in self._blocks if isinstance(block, Plant)]
        self._plant = self._plants[0] if len(self._plants) == 1 else None
        self._controller = next((b for b in self._blocks if isinstance(b, Controller)), None)
        self._watches = dict[Plant, DivergenceWatch]()
        self._start = context.get_continuous_state_vector().CopyToVector()
        self._state = self._state_in(context)
        self._steps, self._mark = 0, self._time
        self._is_warning = config.use_error_control
        self._is_warning &= not config.integration_scheme.startswith(IMPLICIT)
        self._seen, self._longest, self._collapsed = self._time, 0.0, np.inf

    def begin(self, context: Context) -> bool:
        """From here on divergence is an error; whether there is a plant that may diverge."""
        self._watches = {plant: DivergenceWatch(plant, self._duration) for plant in self._plants}
        self._check_divergence(context)
        return bool(self._watches)

    def look(self, context: Context, steps: int = 0, *, is_last: bool = False) -> None:
        """Looks at the run after some accepted steps, of single ones at every 32nd."""
        before, self._steps = self._steps, self._steps + steps
        is_due = self._steps // EVERY > before // EVERY
        if is_due or is_last:
            self._check_divergence(context, is_last=is_last)
        if is_due and self._plant is not None:
            # Steps that become ever shorter end the run, if there is a cause.
            time = context.get_time()
            step = (time - self._seen) / EVERY
            self._seen, self._longest = time, max(self._longest, step)
            if step <= min(COLLAPSED * self._longest, 0.01 * self._collapsed):
                self._collapsed = step
                state = self._state_in(context)
                short = SimulationError("steps have become too short", time, state)
                if (found := self._explained(short, self._plant)) is not short:
                    raise found
        if self._is_warning and before // PACE < self._steps // PACE:
            time = context.get_time()
            pace, self._mark = (time - self._mark) / PACE, time
            left = self._time + self._duration - time
            count = self._steps + left / pace if pace > 0.0 else 0.0
            self._is_warning = count < MANY or not warn_if_stiff(
                self._diagram, context, pace, count, IN_SIMULATE
            )

    def explain(self, error: DrakeDaeError | RuntimeError, context: Context) -> DrakeDaeError:
        """The error with its cause.

        Looked for in this order: divergence within a few steps, ports without wires, a singular
        A(x) or B(x) and the reach of the path, drives at their limits, and steps that are too long
        for a stiff loop.
        """
        try:
            self._check_divergence(context, states_only=True)
        except SimulationError as diverged:
            error = diverged
        if not isinstance(error, DrakeDaeError) and (ports := self._without_wires(context, error)):
            return WiringError(f"no wire to {', '.join(ports)}: connect or fix each input port")
        if isinstance(error, WiringError):
            return error  # It names its cause.
        state = context.get_continuous_state_vector().CopyToVector()
        if self._plant is not None:
            state = self._state_in(context)
        told = error
        if not isinstance(told, SimulationError):
            told = cannot_go_on(context.get_time(), state, str(error))
        elif not told.state.size:
            told = told.retold(str(told), told.time, state)
        if self._plant is not None and (found := self._explained(told, self._plant)) is not told:
            return found
        if names := self._cut_off(context):
            text = f"{', '.join(names)} cut off at their limits: slower references need less"
            return told.retold(f"{text}. {told}", told.time, told.state)
        return too_long(told, self._diagram, context, self._config, (self._time, self._start))

    def _state_in(self, context: Context) -> FloatArray:
        """The state of the only plant; empty where there are others or none."""
        if self._plant is None:
            return np.zeros(0)
        return self._plant.state(self._plant.GetMyContextFromRoot(context))

    def _explained(self, error: SimulationError, plant: Plant) -> SimulationError:
        structure = None if self._controller is None else self._controller.law.structure
        generator = next((b for b in self._blocks if isinstance(b, ReferenceGenerator)), None)
        reference = None if generator is None else generator.reference
        return explained(error, plant, structure, reference, (self._time, self._state))

    def _without_wires(self, context: Context, error: RuntimeError) -> list[str]:
        """The input ports without a value that Drake misses."""
        return [
            f"'{port.get_name()}' of '{block.get_name()}'"
            for block in self._blocks
            for port in map(block.get_input_port, range(block.num_input_ports()))
            if f"({port.get_name()})" in str(error)
            and not port.HasValue(block.GetMyContextFromRoot(context))
        ]

    def _cut_off(self, context: Context) -> list[str]:
        """The controls beyond the limits of the drives."""
        limits = next((b for b in self._blocks if isinstance(b, ControlLimits)), None)
        if limits is None or self._plant is None:
            return []
        try:
            excess = limits.GetOutputPort("excess").Eval(limits.GetMyContextFromRoot(context))
        except (DrakeDaeError, RuntimeError):
            return []
        return [self._plant.dae.control_signals[i].name for i in np.flatnonzero(excess)]

    def _check_divergence(
        self, context: Context, *, is_last: bool = False, states_only: bool = False
    ) -> None:
        for plant, watch in self._watches.items():
            rows: _Rows = {
                "state": (plant.state(plant.GetMyContextFromRoot(context)), plant.dae.state_signals)
            }
            if self._controller is not None and self._plant is not None and not states_only:
                rows |= self._compared(context, plant, self._controller)
            row = {name: Recorded(one[None], tuple(of)) for name, (one, of) in rows.items()}
            watch.look(computed_record(np.array([context.get_time()]), row), is_last=is_last)

    def _compared(self, context: Context, plant: Plant, controller: Controller) -> _Rows:
        """Present values of force, control and outputs, and what outputs are compared with."""
        local, dae, given = (
            plant.GetMyContextFromRoot(context),
            plant.dae,
            plant.GetInputPort("control"),
        )

        def value(name: str) -> FloatArray:
            return np.array(plant.GetOutputPort(name).Eval(local))

        rows: _Rows = {"constraint_force": (value("constraint_force"), dae.force_signals)}
        if given.HasValue(local):
            rows["control"] = np.array(given.Eval(local)), dae.control_signals
        compared = controller.compared(controller.GetMyContextFromRoot(context), value)
        if compared is None:
            return rows | {"controlled_output": (value("controlled_output"), dae.output_signals)}
        outputs, wanted, signals = compared
        return rows | {"controlled_output": (outputs, signals), "desired_output": (wanted, signals)}


def warn_if_stiff(
    diagram: System, context: Context, pace: float, count: float, remedy: str
) -> bool:
    """Warns where the fastest rate, not the accuracy, makes the mean step in s short."""
    state = context.get_continuous_state_vector().CopyToVector()
    rate = fastest_rate(diagram, context, context.get_time(), state)
    if not rate * pace > 1.0:
        return False
    text = (
        f"the loop is stiff: its fastest rate of {rate:.3g} 1/s, not the accuracy, makes explicit "
        f"steps of {pace:.2g} s, of which this run needs about {count:.2g}. {remedy}"
    )
    warnings.warn(text, stacklevel=4)
    return True


def too_long(
    error: SimulationError,
    diagram: System,
    context: Context,
    config: SimulatorConfig,
    start: tuple[float, FloatArray],
) -> SimulationError:
    """The error of a run, with fixed steps that are too long for the fastest rate at its start."""
    step, scheme = config.max_step_size, config.integration_scheme
    if config.use_error_control or scheme.startswith(IMPLICIT) or not start[1].size:
        return error
    begun, rates = context.Clone(), [fastest_rate(diagram, context, *start)]
    begun.SetTimeAndContinuousState(*start)
    # A law that cancels springs takes their rates out of the loop, and not out of its steps.
    for plant in (block for block in _blocks_of(diagram) if isinstance(block, Plant)):
        alone = plant.CreateDefaultContext()
        for i in range(plant.num_input_ports()):
            if size := plant.get_input_port(i).size():
                plant.get_input_port(i).FixValue(alone, np.zeros(size))
        state = plant.state(plant.GetMyContextFromRoot(begun))
        if alone.num_continuous_states() == state.size:
            rates.append(fastest_rate(plant, alone, start[0], state))
    rate = float(np.max(np.nan_to_num(rates)))
    if not rate * step > LONGEST:
        return error
    text = (
        f"the fixed steps of {step:.3g} s are too long for the fastest rate of the loop, "
        f"{rate:.3g} 1/s, such as that of elastic joints: take steps of at most "
        f"{LONGEST / rate:.2g} s, or error control"
    )
    return error.retold(f"{text}. {error}", error.time, error.state)


def fastest_rate(diagram: System, context: Context, time: float, state: FloatArray) -> float:
    """The largest |eigenvalue| of the derivative of a diagram's continuous state, in 1/s.

    By central differences, in a copy of the context; nan where the derivative has no value.
    """
    copy, columns = context.Clone(), []
    try:
        for i, step in enumerate(1e-6 * np.maximum(1.0, np.abs(state))):
            slopes = []
            for moved in (state[i] + step, state[i] - step):
                copy.SetTimeAndContinuousState(time, np.r_[state[:i], moved, state[i + 1 :]])
                slopes.append(diagram.EvalTimeDerivatives(copy).CopyToVector())
            columns.append((slopes[0] - slopes[1]) / (2.0 * step))
        return float(np.max(np.abs(np.linalg.eigvals(np.array(columns).T)), initial=0.0))
    except (DrakeDaeError, RuntimeError, np.linalg.LinAlgError):
        return np.nan
