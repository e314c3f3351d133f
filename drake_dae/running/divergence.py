"""Runs that diverge: a state, a control or a tracking error leaves all measure, and since when."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import Context, System

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record, computed_record, recorded_values
from drake_dae.errors import SimulationError
from drake_dae.running.diagnosis import blocks_of
from drake_dae.running.judgement import unit_sizes
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.plants.contract import Plant

EVERY = 32
"""The number of steps from one check to the next, since each check evaluates output ports."""

LASTING, ENORMOUS = 100.0, 1e6
"""The ratio of an error to the size of its output that is divergence: as a mean over the `WINDOW`,
and at a single time."""

BEYOND = 1e9
"""The ratio of a state or a control to its size that is divergence. A joint that turns all day does
not reach it."""

WINDOW = 0.01
"""The fraction of a run over which errors are averaged. The logarithms are averaged, so that the
peak of an impact hardly counts."""

MEANINGFUL = 1e-6
"""Outputs and controls whose size is below this fraction of the largest number at the start are not
judged: their size may be round-off."""


_Rows = dict[str, tuple[FloatArray, Sequence[Signal]]]
"""Name of a signal -> its present values, with their names and units."""


class _Growth:
    """Ratios of signals to their sizes, and since when they are above the usual ones."""

    def __init__(
        self,
        signals: Sequence[Signal],
        time: float,
        usual: float,
        most: float,
        lasting: float = np.inf,
        window: float = np.inf,
    ) -> None:
        self.signals, self._time = signals, time
        self._usual, self._most, self._lasting, self._window = usual, most, lasting, window
        self._mean, self.since = np.zeros(len(signals)), np.full(len(signals), time)

    def beyond(self, times: FloatArray, ratios: FloatArray) -> tuple[int, int] | None:
        """The first row with a ratio beyond all measure, and the signal; None if there is none."""
        if not ratios.size or (ratios <= self._usual).all():
            self._mean *= np.exp((self._time - times[-1]) / self._window)
            self.since[:] = self._time = float(times[-1])
            return None
        for row, (time, ratio) in enumerate(zip(times.tolist(), ratios, strict=True)):
            weight = -np.expm1((self._time - time) / self._window)
            self._mean += weight * (np.log(np.maximum(ratio, 1.0)) - self._mean)
            self.since[ratio <= self._usual] = self._time = time
            is_beyond = (ratio > self._most) | (self._mean > np.log(self._lasting))
            if is_beyond.any():
                return row, int(np.argmax(np.where(is_beyond, ratio, 0.0)))
        return None


class DivergenceWatch:
    """Raises an error if states, controls or tracking errors grow beyond all bounds.

    A state is compared with its initial value and with `DaeSystem.scale`. The tracking error z - r
    of an output is compared with the largest value of the reference up to now, and of outputs,
    states, forces and controls at the start, in the same unit. A control is compared with the
    initial values in its unit, and only at the end of the run: if it is large before, as near a
    singular configuration, the run fails with a better message. So no verdict depends on units, and
    the force of an impact, the sag under a payload or a distant start are not divergence.
    """

    def __init__(self, plant: Plant, duration: float) -> None:
        self._plant, self._window = plant, WINDOW * duration
        self._states: _Growth | None = None
        self._errors: _Growth | None = None

    def look(self, record: Record, *, is_last: bool = False) -> None:
        """Checks the next rows of a record; without a reference, its states alone."""
        if not record.time.size:
            return
        dae, time, states = self._plant.dae, float(record.time[0]), record["state"]
        if self._states is None:
            names = ("state", "controlled_output", "constraint_force", "control")
            rows = [record.signals[name] for name in names if name in record]
            self._sizes = unit_sizes(*((r.signals, r.values[:1]) for r in rows), least={})
            self._largest = max(self._sizes.values(), default=0.0)
            self._scale = np.maximum(dae.scale, np.abs(states[0]))
            self._states = _Growth(dae.state_signals, time, 10.0, BEYOND)
            self._controls = _Growth(dae.control_signals, time, 10.0, BEYOND)
            units = [self._sizes.get(signal.unit, 0.0) for signal in dae.control_signals]
            self._control_scale = self._meaningful(np.array(units))
            # One radian; the length 1 of an axis of a robot's frame.
            for unit in ("rad", "") if self._plant.model is not None else ("rad",):
                self._sizes[unit] = max(1.0, self._sizes.get(unit, 0.0))
        found = [self._first(self._states, record, states, np.tile(self._scale, (len(states), 1)))]
        if "desired_output" in record:
            wanted, signals = record["desired_output"], record.signals["desired_output"].signals
            self._errors = self._errors or _Growth(
                signals, time, 1.0, ENORMOUS, LASTING, self._window
            )
            errors, sizes = record["controlled_output"] - wanted, self._along(signals, wanted)
            found.append(self._first(self._errors, record, errors, sizes))
        if is_last and "control" in record:
            sizes = np.tile(self._control_scale, (len(states), 1))
            found.append(self._first(self._controls, record, record["control"], sizes))
        if failures := [failure for failure in found if failure is not None]:
            raise min(failures, key=lambda failure: failure.time)

    def _first(
        self, growth: _Growth, record: Record, values: FloatArray, sizes: FloatArray
    ) -> SimulationError | None:
        """The error of the first row in which a value is beyond its size."""
        place = growth.beyond(record.time, np.abs(values) / sizes)
        if place is None:
            return None
        row, i = place
        signal, unit = growth.signals[i], f" {growth.signals[i].unit}".rstrip()
        what = f"the error of {signal.name}" if growth is self._errors else signal.name
        time, value, size = float(record.time[row]), values[row, i], sizes[row, i]
        return SimulationError(
            f"the run diverges: at t = {time:.6g} s {what} is {value:.3g}{unit}, "
            f"{abs(value) / size:.2g} times the {size:.3g}{unit} that it is large in use, and it "
            f"has grown since {growth.since[i]:.4g} s. The loop is unstable, or the robot cannot "
            "do what is asked: choose slower gains, a shorter period and delay of the law, or a "
            "plant that is nearer to the law's model. With judgement.may_diverge the run goes on "
            "all the same",
            time,
            record["state"][row],
        )

    def _meaningful(self, sizes: FloatArray) -> FloatArray:
        """Sizes, infinite where they may be round-off."""
        largest = np.maximum(self._largest, sizes.max(axis=-1, initial=0.0, keepdims=True))
        return np.where(sizes > MEANINGFUL * largest, sizes, np.inf)

    def _along(self, signals: Sequence[Signal], wanted: FloatArray) -> FloatArray:
        """The sizes of all outputs at each time, from what was wanted up to then."""
        units, along = np.array([signal.unit for signal in signals]), np.zeros_like(wanted)
        for unit in dict.fromkeys(units.tolist()):
            columns = units == unit
            largest = np.nan_to_num(np.abs(wanted[:, columns]), posinf=0.0).max(axis=1)
            grown = np.maximum.accumulate(np.maximum(largest, self._sizes.get(unit, 0.0)))
            self._sizes[unit] = float(grown[-1])
            along[:, columns] = grown[:, None]
        return self._meaningful(along)


class DiagramWatch:
    """`DivergenceWatch` of each `Plant` in a diagram while it runs.

    The errors of a `Controller` are checked if there is exactly one plant.
    """

    def __init__(self, diagram: System, context: Context, duration: float) -> None:
        blocks = list(blocks_of(diagram))
        plants = [block for block in blocks if isinstance(block, Plant)]
        self._controller = next((b for b in blocks if isinstance(b, Controller)), None)
        self._watches = {plant: DivergenceWatch(plant, duration) for plant in plants}
        self._diagram, self._steps = diagram, 0
        self.look(context, always=True)

    @property
    def sees(self) -> bool:
        """Whether there is a plant to check."""
        return bool(self._watches)

    def look(
        self,
        context: Context,
        steps: int = 1,
        *,
        always: bool = False,
        is_last: bool = False,
        states_only: bool = False,
    ) -> None:
        """Checks an accepted step; of consecutive steps only every 32nd is checked."""
        self._steps += steps
        if self._steps < EVERY and not (always or is_last or states_only):
            return
        self._steps = 0
        for plant, watch in self._watches.items():
            at_plant, dae = plant.GetMyContextFromRoot(context), plant.dae
            rows: _Rows = {"state": (plant.state(at_plant), dae.state_signals)}
            if self._controller is not None and len(self._watches) == 1 and not states_only:
                rows |= self._outputs(context, plant, at_plant)
            signals = {
                name: recorded_values(values[None], tuple(of))
                for name, (values, of) in rows.items()
            }
            watch.look(computed_record(np.array([context.get_time()]), signals), is_last=is_last)

    def _outputs(self, context: Context, plant: Plant, at_plant: Context) -> "_Rows":
        """The signals of the plant with what its controller compares."""
        dae, controller = plant.dae, self._controller
        assert controller is not None

        def value(name: str) -> FloatArray:
            if name == "state":
                return plant.state(at_plant)
            if name != "control":
                return np.array(plant.GetOutputPort(name).Eval(at_plant))
            port = plant.GetInputPort("control")
            if port.HasValue(at_plant):
                return np.array(port.Eval(at_plant))
            # The plant evaluates the law itself.
            if not self._diagram.HasOutputPort("control"):
                return np.zeros(0)
            return np.array(self._diagram.GetOutputPort("control").Eval(context))

        force, control = value("constraint_force"), value("control")
        rows: _Rows = {"constraint_force": (force, dae.force_signals)}
        if control.size:
            rows["control"] = control, dae.control_signals
        compared = controller.compared(controller.GetMyContextFromRoot(context), value)
        if compared is not None:
            outputs, wanted, signals = compared
            rows |= {"controlled_output": (outputs, signals), "desired_output": (wanted, signals)}
        else:
            rows["controlled_output"] = value("controlled_output"), dae.output_signals
        return rows
