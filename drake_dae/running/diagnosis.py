"""Why a run ends: one diagnosis for all ends, and divergence while it runs."""

from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray, show_state
from drake_dae.blocks.failures import cannot_go_on, singular_configuration
from drake_dae.dae import ConstraintStructure, Signal, Structure
from drake_dae.diagrams.record import Record
from drake_dae.errors import DrakeDaeError, PainleveError, SimulationError, SingularityError
from drake_dae.running.judgement import unit_sizes
from drake_dae.systems.controller import Compared, Controller
from drake_dae.systems.plant import Plant
from drake_dae.trace.numerics import equilibration, smallest_singular_value

# The smallest singular value of A(x) or B(x), rows and columns scaled by their usual sizes, below
# which it is why a run ends: steps become too short long before it is zero.
SINGULAR = 1e-2
PART = 0.3  # The share of the largest part in a singular direction from which an output is named.
# A run is looked at each so many steps; below this share of the longest mean they collapsed.
EVERY, COLLAPSED = 32, 1e-5

# An error of so many sizes of its output diverges; the force of an impact is far below.
ENORMOUS = 1e5
# A state of so many sizes diverges; a joint that turns all day does not reach it.
GROWN = 1e9
# Outputs of a size below this share of the largest one are not judged: it may be round-off.
MEANINGFUL = 1e-6


class RunWatch:
    """Looks at a run from a context on: does it diverge, or stop, and why."""

    def __init__(self, diagram: System, context: Context, may_diverge: bool) -> None:
        self._blocks = list(_blocks_of(diagram))
        plants = [block for block in self._blocks if isinstance(block, Plant)]
        self._plant = plants[0] if len(plants) == 1 else None
        self._controller = next((b for b in self._blocks if isinstance(b, Controller)), None)
        self._watches = {p: DivergenceWatch(p) for p in plants if not may_diverge}
        self._steps, self._seen = 0, context.get_time()
        self._longest, self._collapsed = 0.0, np.inf

    def look(self, context: Context, steps: int = 0, *, is_last: bool = False) -> None:
        """Looks at the run after some accepted steps, of single ones at every 32nd."""
        before, self._steps = self._steps, self._steps + steps
        is_due = self._steps // EVERY > before // EVERY
        if is_due or is_last:
            self._check_divergence(context)
        if is_due and self._plant is not None and self._controller is not None:
            # Steps that become ever shorter end the run, if there is a cause.
            time = context.get_time()
            step, self._seen = (time - self._seen) / EVERY, time
            self._longest = max(self._longest, step)
            if step <= min(COLLAPSED * self._longest, 0.01 * self._collapsed):
                self._collapsed, state = step, self._state_in(context)
                short = SimulationError("steps have become too short", time, state)
                if (found := with_cause(short, self._plant, self._controller)) is not short:
                    raise found

    def explain(self, error: DrakeDaeError | RuntimeError, context: Context) -> DrakeDaeError:
        """The error with its cause: divergence, or as `with_cause`."""
        try:
            self._check_divergence(context, states_only=True)
        except SimulationError as diverged:
            return diverged
        state = self._state_in(context)
        if not isinstance(error, SimulationError):
            error = cannot_go_on(context.get_time(), state, str(error))
        elif not error.state.size:
            error = error.retold(str(error), error.time, state)
        return with_cause(error, self._plant, self._controller)

    def _state_in(self, context: Context) -> FloatArray:
        """The state of the only plant, or else all continuous states."""
        if self._plant is None:
            return context.get_continuous_state_vector().CopyToVector()
        return self._plant.state(self._plant.GetMyContextFromRoot(context))

    def _check_divergence(self, context: Context, *, states_only: bool = False) -> None:
        """Looks at the present states; of a single plant also at its outputs."""
        time, plant, controller = np.array([context.get_time()]), self._plant, self._controller
        compared: Compared | None = None
        if plant is not None and controller is not None and not states_only:
            at_plant = plant.GetMyContextFromRoot(context)

            def shown(name: str) -> FloatArray:
                return np.array(plant.GetOutputPort(name).Eval(at_plant))

            compared = controller.compared(controller.GetMyContextFromRoot(context), shown)
        outputs, desired, signals = compared or (np.zeros(0), np.zeros(0), ())
        for each, watch in self._watches.items():
            state = each.state(each.GetMyContextFromRoot(context))
            watch.check(time, state[None], outputs[None], desired[None], signals)


def with_cause(
    error: SimulationError, plant: Plant | None, controller: Controller | None
) -> SimulationError:
    """The error; if A(x) or B(x) is singular at its state, one that names what depends there."""
    state, time = error.state, error.time
    if plant is None or controller is None or isinstance(error, PainleveError):
        return error
    is_known = isinstance(error, SingularityError) and error.constraints
    if is_known or state.size != plant.dae.num_states or not np.isfinite(state).all():
        return error
    own, structure, name = plant.structure, controller.law.structure, plant.dae.name
    if plant.is_ideal and _margin(own, own.elimination.constraint_matrix, state)[0] < SINGULAR:
        names = own.dependent_constraints(state, plant.dae.parameter_values)
        return singular_configuration(name, time, state, names)
    system = structure.system
    if state.size != system.num_states:
        return error
    outputs = _dependent(structure, structure.control_matrix, system.output_signals, state)
    if not outputs:
        return error
    gradients = ca.jacobian(ca.vertcat(system.k, system.l), system.state)
    signals = (*system.constraint_output_signals, *system.output_signals)
    names = _dependent(structure, gradients, signals, state)
    constraints = tuple(s.name for s in system.constraint_output_signals if s.name in names)
    held = f" beside {', '.join(constraints)}" if constraints else ""
    singular = SingularityError(
        f"{name}: B(x) of Assumption (5) is singular at t = {time:.6g} s, state "
        f"{show_state(state)}: there the drives cannot steer {', '.join(outputs)}{held}. Keep the "
        "reference away from there, or choose another posture or other outputs",
        time,
        state,
    )
    singular.constraints = constraints
    return singular


def _dependent(
    structure: Structure, matrix: ca.SX, signals: Sequence[Signal], state: FloatArray
) -> tuple[str, ...]:
    """The signals whose rows in a matrix depend on each other at a state, except rows of 0."""
    rows = [i for i in range(matrix.rows()) if matrix[i, :].nnz()]
    margin, part = _margin(structure, matrix[rows, :], state)
    if not margin < SINGULAR:
        return ()
    return tuple(signals[rows[i]].name for i in np.flatnonzero(part > PART * part.max()))


def _margin(
    structure: ConstraintStructure, matrix: ca.SX, state: FloatArray
) -> tuple[float, FloatArray]:
    """The smallest singular value of a scaled matrix, and the parts of its rows in it."""
    if not matrix.numel():
        return np.inf, np.zeros(0)
    at = structure.system.matrix("margin", matrix)
    values = structure.system.parameter_values
    rows, columns = equilibration(
        np.mean([np.abs(at(x, values)) for x in structure.states], axis=0)
    )
    value = at(state, values) / rows[:, None] / columns
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


class DivergenceWatch:
    """Raises an error if states or tracking errors grow beyond all bounds, in any units.

    A state is compared with its initial value and `DaeSystem.scale`, an error z - r with the
    largest reference so far, and the outputs at the start, in its unit.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant, self._state_sizes = plant, np.zeros(0)
        self._sizes: dict[str, float] = {}

    def look(self, record: Record) -> None:
        """Checks the next rows of a record; without a reference, its states alone."""
        signals, none = tuple[Signal, ...](), np.zeros((record.time.size, 0))
        outputs, desired = none, none
        if "desired_output" in record:
            outputs, desired = record["controlled_output"], record["desired_output"]
            signals = record.signals["desired_output"].signals
        self.check(record.time, record["state"], outputs, desired, signals)

    def check(
        self,
        times: FloatArray,
        states: FloatArray,
        outputs: FloatArray,
        desired: FloatArray,
        signals: Sequence[Signal],
    ) -> None:
        """Checks some rows of states, outputs and their desired values."""
        dae = self._plant.dae
        if not self._state_sizes.size:
            self._state_sizes = np.maximum(dae.scale, np.abs(states[0]))
            # One radian; the length 1 of an axis of a robot's frame.
            least = {"rad": 1.0, "": 1.0} if self._plant.model is not None else {"rad": 1.0}
            self._sizes = unit_sizes((signals, outputs[:1]), least=least)
        self._sizes = unit_sizes((signals, desired), least=self._sizes)
        sizes = np.array([self._sizes[signal.unit] for signal in signals])
        sizes[sizes <= MEANINGFUL * sizes.max(initial=0.0)] = np.inf
        values = np.hstack([states, outputs - desired])
        sizes = np.concatenate([self._state_sizes, sizes])
        most = np.repeat([GROWN, ENORMOUS], [dae.num_states, len(signals)])
        shares = np.abs(values) / sizes / most
        is_beyond = (shares > 1.0).any(axis=1)
        if not is_beyond.any():
            return
        row = int(np.argmax(is_beyond))
        i = int(np.nanargmax(shares[row]))
        signal, what = [*dae.state_signals, *signals][i], "the error of " * (i >= dae.num_states)
        unit, time = f" {signal.unit}".rstrip(), float(times[row])
        raise SimulationError(
            f"the run diverges: at t = {time:.6g} s {what}{signal.name} is {values[row, i]:.3g}"
            f"{unit}, {shares[row, i] * most[i]:.2g} times the {sizes[i]:.3g}{unit} that it is "
            "large in use. The loop is unstable, or the robot cannot do what is asked: choose "
            "slower gains, a shorter period and delay of the law, or a plant that is nearer to the "
            "law's model. With judgement.may_diverge the run goes on all the same",
            time,
            states[row],
        )
