"""Why a run ends: one diagnosis for all ends, and divergence and stiffness while it runs."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress

import casadi as ca
import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray, show_state
from drake_dae.blocks.failures import cannot_go_on, singular_configuration
from drake_dae.dae import ConstraintStructure, EndCause, Signal, Structure, ZeroDynamics
from drake_dae.diagrams.record import Record, Recorded, computed_record
from drake_dae.errors import (
    DrakeDaeError,
    PainleveError,
    SimulationError,
    SingularityError,
    WiringError,
)
from drake_dae.running.judgement import unit_sizes
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

# An error diverges at this many sizes of its output, as a mean over the window, and at once. The
# mean is that of logarithms, so that the peak of an impact hardly counts.
LASTING, ENORMOUS = 100.0, 1e6
WINDOW = 0.01  # The share of a run over which errors are averaged.
# A state or a control diverges at this many sizes; a joint that turns all day does not reach it.
GROWN = 1e9
# Outputs and controls of a size below this share of the largest number at the start are not judged:
# it may be round-off.
MEANINGFUL = 1e-6

IN_SIMULATE = "Choose integration_scheme 'radau3' or 'implicit_euler', or a slower model"
IN_ROLLOUT = "Run it by simulate with integration_scheme 'radau3', or choose a slower model"


class RunWatch:
    """Looks at a run from a context on: does it diverge, stop, or take very many steps, and why."""

    def __init__(
        self, diagram: System, context: Context, config: SimulatorConfig, duration: float
    ) -> None:
        self._diagram, self._config, self._time = diagram, config, context.get_time()
        self._duration, self._blocks = duration, list(_blocks_of(diagram))
        self._plants = [block for block in self._blocks if isinstance(block, Plant)]
        self._plant = self._plants[0] if len(self._plants) == 1 else None
        self._controller = next((b for b in self._blocks if isinstance(b, Controller)), None)
        self._watches = dict[Plant, DivergenceWatch]()
        self._begun = context.Clone()
        self._start = self._begun.get_continuous_state_vector().CopyToVector()
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
        time, before, self._steps = context.get_time(), self._steps, self._steps + steps
        is_due = self._steps // EVERY > before // EVERY
        if is_due or is_last:
            self._check_divergence(context, is_last=is_last)
        if is_due and self._plant is not None:
            # Steps that become ever shorter end the run, if there is a cause.
            step, self._seen = (time - self._seen) / EVERY, time
            self._longest = max(self._longest, step)
            if step <= min(COLLAPSED * self._longest, 0.01 * self._collapsed):
                self._collapsed, state = step, self._state_in(context)
                short = SimulationError("steps have become too short", time, state)
                if (found := self._singular(short)) is not short:
                    raise found
        if self._is_warning and before // PACE < self._steps // PACE:
            pace, self._mark = (time - self._mark) / PACE, time
            left = self._time + self._duration - time
            count = self._steps + left / pace if pace > 0.0 else 0.0
            self._is_warning = count < MANY or not warn_if_stiff(
                self._diagram, context, pace, count, IN_SIMULATE
            )

    def explain(self, error: DrakeDaeError | RuntimeError, context: Context) -> DrakeDaeError:
        """The error with its cause: divergence, a port without a wire, or as `with_cause`."""
        try:
            self._check_divergence(context, states_only=True)
        except SimulationError as diverged:
            error = diverged
        if not isinstance(error, DrakeDaeError):
            ports = [
                f"'{port.get_name()}' of '{block.get_name()}'"
                for block in self._blocks
                for port in map(block.get_input_port, range(block.num_input_ports()))
                if f"({port.get_name()})" in str(error)
                and not port.HasValue(block.GetMyContextFromRoot(context))
            ]
            if ports:
                text = f"no wire to {', '.join(ports)}: connect or fix each input port"
                return WiringError(text)
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
        return self.with_cause(told, context)

    def with_cause(self, error: SimulationError, context: Context | None = None) -> SimulationError:
        """With a singular A(x) or B(x), the reach, drives cut off at the end, or too long steps."""
        if (found := self._singular(error)) is not error:
            return found
        limits = next((b for b in self._blocks if isinstance(b, ControlLimits)), None)
        if context is not None and limits is not None and self._plant is not None:
            excess: FloatArray = np.zeros(0)
            with suppress(DrakeDaeError, RuntimeError):
                local = limits.GetMyContextFromRoot(context)
                excess = limits.GetOutputPort("excess").Eval(local)
            signals = self._plant.dae.control_signals
            if names := [signals[i].name for i in np.flatnonzero(excess)]:
                text = f"{', '.join(names)} cut off at their limits: slower references need less"
                return error.retold(f"{text}. {error}", error.time, error.state)
        return self._too_long(error)

    def _state_in(self, context: Context) -> FloatArray:
        """The state of the only plant; empty where there are others or none."""
        if self._plant is None:
            return np.zeros(0)
        return self._plant.state(self._plant.GetMyContextFromRoot(context))

    def _check_divergence(
        self, context: Context, *, is_last: bool = False, states_only: bool = False
    ) -> None:
        """Looks at the present states; of a single plant also at force, control and outputs."""
        for plant, watch in self._watches.items():
            local, dae, control = (
                plant.GetMyContextFromRoot(context),
                plant.dae,
                plant.GetInputPort("control"),
            )
            rows = dict[str, tuple[FloatArray, Sequence[Signal]]]()
            rows["state"] = plant.state(local), dae.state_signals
            if self._controller is not None and self._plant is not None and not states_only:

                def value(name: str, plant: Plant = plant, local: Context = local) -> FloatArray:
                    return np.array(plant.GetOutputPort(name).Eval(local))

                rows["constraint_force"] = value("constraint_force"), dae.force_signals
                if control.HasValue(local):
                    rows["control"] = np.array(control.Eval(local)), dae.control_signals
                at_controller = self._controller.GetMyContextFromRoot(context)
                compared = self._controller.compared(at_controller, value)
                if compared is None:
                    rows["controlled_output"] = value("controlled_output"), dae.output_signals
                else:
                    outputs, wanted, signals = compared
                    rows["controlled_output"] = outputs, signals
                    rows["desired_output"] = wanted, signals
            row = {name: Recorded(one[None], tuple(of)) for name, (one, of) in rows.items()}
            watch.look(computed_record(np.array([context.get_time()]), row), is_last=is_last)

    def _singular(self, error: SimulationError) -> SimulationError:
        """The error with its cause if A(x) or B(x) is singular, or the path leaves its reach."""
        plant = self._plant
        if plant is None or isinstance(error, PainleveError):
            return error
        if isinstance(error, SingularityError) and error.constraints:
            return error
        name, state, own = plant.dae.name, error.state, getattr(plant, "structure", None)
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
        if self._controller is None:
            return error
        structure = self._controller.law.structure
        system, ending, limit, lasted = structure.system, None, SINGULAR, error.time - self._time
        sizes = sum(degree + 1 for degree in structure.layout.reference_degrees)
        generators = [b for b in self._blocks if isinstance(b, ReferenceGenerator)]
        generator = next((g for g in generators if g.get_output_port().size() == sizes), None)
        if generator is not None and lasted > 0.0 and not system.exogenous.moving:
            times = np.linspace(self._time, error.time + BEYOND * lasted, PLACES)
            with suppress(DrakeDaeError):
                zero = ZeroDynamics(system, structure=structure)
                ending = zero.motion(generator.reference, times, self._state).ending
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
            f"{told}. Keep the reference away from there, or choose another posture or other "
            f"outputs. The run ended at t = {error.time:.6g} s, state {show_state(error.state)}"
        )
        if not outputs and not (ending is not None and ending.matrix):
            return SimulationError(told, error.time, error.state)
        singular = SingularityError(told, error.time, error.state)
        singular.constraints = constraints
        return singular

    def _too_long(self, error: SimulationError) -> SimulationError:
        """The error, with fixed steps that are too long for the fastest rate at the start."""
        step, scheme = self._config.max_step_size, self._config.integration_scheme
        if self._config.use_error_control or scheme.startswith(IMPLICIT) or not self._start.size:
            return error
        rates = [fastest_rate(self._diagram, self._begun, self._time, self._start)]
        # A law that cancels springs takes their rates out of the loop, and not out of its steps.
        for plant in self._plants:
            alone = plant.CreateDefaultContext()
            for i in range(plant.num_input_ports()):
                if size := plant.get_input_port(i).size():
                    plant.get_input_port(i).FixValue(alone, np.zeros(size))
            state = plant.state(plant.GetMyContextFromRoot(self._begun))
            if alone.num_continuous_states() == state.size:
                rates.append(fastest_rate(plant, alone, self._time, state))
        rate = float(np.max(np.nan_to_num(rates)))
        if not rate * step > LONGEST:
            return error
        text = (
            f"the fixed steps of {step:.3g} s are too long for the fastest rate of the loop, "
            f"{rate:.3g} 1/s, such as that of elastic joints: take steps of at most "
            f"{LONGEST / rate:.2g} s, or error control"
        )
        return error.retold(f"{text}. {error}", error.time, error.state)


def _dependent(
    structure: Structure, matrix: ca.SX, signals: Sequence[Signal], state: FloatArray, limit: float
) -> tuple[str, ...]:
    """The signals whose rows in a matrix depend on each other at a state, except rows of 0."""
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


class DivergenceWatch:
    """Raises an error if states, controls or tracking errors grow beyond all bounds.

    A state is compared with its initial value and `DaeSystem.scale`, an error z - r with the
    largest reference so far and what has its unit at the start, a control with that at the end
    only: if it is large before, as near a singular configuration, the run fails with a better
    message. So no verdict depends on units, and the force of an impact is no divergence.
    """

    def __init__(self, plant: Plant, duration: float) -> None:
        self._plant, self._window, self._has_begun = plant, WINDOW * duration, False

    def _begin(self, record: Record) -> None:
        """Keeps the sizes at the start, and the bounds of states, outputs and controls."""
        dae, self._has_begun, self._time = self._plant.dae, True, float(record.time[0])
        names = ("state", "controlled_output", "constraint_force", "control")
        rows = [record.signals[name] for name in names if name in record]
        self._sizes = unit_sizes(*((r.signals, r.values[:1]) for r in rows), least={})
        self._largest = max(self._sizes.values(), default=0.0)
        self._state_sizes = np.maximum(dae.scale, np.abs(record["state"][0]))
        controls = np.array([self._sizes.get(signal.unit, 0.0) for signal in dae.control_signals])
        self._control_sizes = self._meaningful(controls)
        # One radian; the length 1 of an axis of a robot's frame.
        for unit in ("rad", "") if self._plant.model is not None else ("rad",):
            self._sizes[unit] = max(1.0, self._sizes.get(unit, 0.0))
        self._outputs = tuple[Signal, ...]()
        if "desired_output" in record:
            self._outputs = record.signals["desired_output"].signals
        self._signals = [*dae.state_signals, *self._outputs, *dae.control_signals]
        counts = [dae.num_states, len(self._outputs), dae.num_controls]
        self._is_output = np.repeat([False, True, False], counts)
        self._usual = np.where(self._is_output, 1.0, 10.0)
        self._most = np.where(self._is_output, ENORMOUS, GROWN)
        self._is_control = np.repeat([False, False, True], counts)
        self._mean, self._since = np.zeros(sum(counts)), np.full(sum(counts), self._time)

    def look(self, record: Record, *, is_last: bool = False) -> None:
        """Checks the next rows of a record; without a reference, its states alone."""
        if not record.time.size:
            return
        if not self._has_begun:
            self._begin(record)
        times, states, shape = record.time, record["state"], (record.time.size, len(self._signals))
        values, sizes = np.zeros(shape), np.ones(shape)
        values[:, : states.shape[1]], sizes[:, : states.shape[1]] = states, self._state_sizes
        if "desired_output" in record:
            wanted = record["desired_output"]
            values[:, self._is_output] = record["controlled_output"] - wanted
            sizes[:, self._is_output] = self._output_sizes(wanted)
        if "control" in record:
            values[:, self._is_control] = record["control"]
            sizes[:, self._is_control] = self._control_sizes
        ratios = np.abs(values) / sizes
        if (ratios <= self._usual).all():
            self._mean *= np.exp((self._time - times[-1]) / self._window)
            self._since[:] = self._time = float(times[-1])
            return
        most = np.where(self._is_control & (not is_last), np.inf, self._most)
        for row, (time, ratio) in enumerate(zip(times.tolist(), ratios, strict=True)):
            weight = -np.expm1((self._time - time) / self._window)
            grown = np.log(np.maximum(np.where(self._is_output, ratio, 1.0), 1.0))
            self._mean += weight * (grown - self._mean)
            self._since[ratio <= self._usual] = self._time = time
            is_beyond = (ratio > most) | (self._mean > np.log(LASTING))
            if is_beyond.any():
                i = int(np.argmax(np.where(is_beyond, ratio / self._most, -1.0)))
                signal, value, size = self._signals[i], values[row, i], sizes[row, i]
                unit, what = f" {signal.unit}".rstrip(), "the error of " * bool(self._is_output[i])
                raise SimulationError(
                    f"the run diverges: at t = {time:.6g} s {what}{signal.name} is {value:.3g}"
                    f"{unit}, {ratio[i]:.2g} times the {size:.3g}{unit} that it is large in use, "
                    f"and it has grown since {self._since[i]:.4g} s. The loop is unstable, or the "
                    "robot cannot do what is asked: choose slower gains, a shorter period and "
                    "delay of the law, or a plant that is nearer to the law's model. With "
                    "judgement.may_diverge the run goes on all the same",
                    time,
                    states[row],
                )

    def _meaningful(self, sizes: FloatArray) -> FloatArray:
        """Sizes, infinite where they may be round-off."""
        largest = np.maximum(self._largest, sizes.max(axis=-1, initial=0.0, keepdims=True))
        return np.where(sizes > MEANINGFUL * largest, sizes, np.inf)

    def _output_sizes(self, wanted: FloatArray) -> FloatArray:
        """The sizes of all outputs at each time, from what was wanted up to then."""
        units, along = np.array([signal.unit for signal in self._outputs]), np.zeros_like(wanted)
        for unit in dict.fromkeys(units.tolist()):
            columns = units == unit
            largest = np.nan_to_num(np.abs(wanted[:, columns]), posinf=0.0).max(axis=1)
            grown = np.maximum.accumulate(np.maximum(largest, self._sizes.get(unit, 0.0)))
            self._sizes[unit] = float(grown[-1])
            along[:, columns] = grown[:, None]
        return self._meaningful(along)


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


def fastest_rate(diagram: System, context: Context, time: float, state: FloatArray) -> float:
    """The largest |eigenvalue| of the derivative of the continuous state in 1/s, or nan."""
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
