"""Runs that end where they diverge, with what grew and since when."""

from collections.abc import Callable, Iterator, Sequence
from typing import Self

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.simulation.records.record import Record
from drake_dae.systems.control.contract import Compared, Controller
from drake_dae.systems.plants.contract import Plant

LASTING = 100.0
"""An error that is so many times the size of its output, on average over the `WINDOW`, diverges."""

ENORMOUS = 1e6
"""An error that is so many times the size of its output diverges at once."""

BEYOND = 1e9
"""A state or a control that is so many times its size diverges at once. A joint that turns all day
does not."""

WINDOW = 0.01
"""The share of a run over which errors are averaged. The mean is that of their logarithms: the peak
of an impact hardly counts."""

KNOWN = 1e-6
"""A smaller size, relative to the largest number that a run starts with, may be round-off: it tells
nothing of an output, which is then not judged."""

EVERY = 32
"""After so many steps one is looked at: an output is computed for it."""


class DivergenceWatch:
    """Ends a run whose states or errors leave all measure.

    A state is compared with its value at the start and with `DaeSystem.scale`, a control with what
    had its unit at the start. The error z - r of
    an output is compared with the largest number in its unit that the reference has had up to now,
    or that outputs, states, forces and controls had at the start. So nothing depends on units, and
    the force of an impact, the sag under a load or a start far away are no divergence.

    Args:
        diagram: What runs: each `Plant` in it is watched, and the errors of a `Controller` that
            knows what they are, where one plant is there.
        context: Its context at the start of the run.
        duration: How long the run lasts, in s.
    """

    def __init__(self, diagram: System, context: Context, duration: float) -> None:
        blocks = list(_blocks(diagram))
        self._plants = [block for block in blocks if isinstance(block, Plant)]
        self._controllers = [block for block in blocks if isinstance(block, Controller)]
        self._controllers *= len(self._plants) == 1
        self._diagram, self._steps, time = diagram, 0, context.get_time()
        self._states = [
            _Amounts.states(plant, time, plant.state(plant.GetMyContextFromRoot(context)))
            for plant in self._plants
        ]
        self._errors: list[tuple[Controller, _Errors]] = []
        self._controls: _Amounts | None = None
        for controller in self._controllers:
            plant = self._plants[0]
            start = _sizes(plant, self._shown(context))
            self._controls = _Amounts.controls(plant, time, start)
            if (now := self._compared(controller, context)) is None:
                continue
            sizes, window = _with(start, now[2], now[0]), WINDOW * duration
            errors = _Errors(now[2], time, window, sizes, _least(plant))
            self._errors.append((controller, errors))

    @property
    def sees(self) -> bool:
        """Whether there is anything to watch."""
        return bool(self._states)

    def look(self, context: Context, *, always: bool = False) -> None:
        """Looks at an accepted step, at some of them.

        Args:
            context: The context of the diagram.
            always: Whether to look at this one, as at the last.

        Raises:
            SimulationError: The run diverges.
        """
        self._steps += 1
        if self._steps % EVERY and not always:
            return
        self.look_at_states(context)
        if not self._controllers:
            return
        times, shown = np.array([context.get_time()]), self._shown(context)
        state, control = shown("state")[None], shown("control")[None]
        if self._controls is not None and control.size:
            _raise_first([self._controls.look(times, control, state)])
        for controller, errors in self._errors:
            if (now := self._compared(controller, context)) is not None:
                _raise_first([errors.look(times, now[0][None], now[1][None], state)])

    def look_at_states(self, context: Context) -> None:
        """Looks at the states alone: where a run has failed, outputs may have no values.

        Raises:
            SimulationError: They diverge.
        """
        times = np.array([context.get_time()])
        for plant, amounts in zip(self._plants, self._states, strict=True):
            state = plant.state(plant.GetMyContextFromRoot(context))[None]
            _raise_first([amounts.look(times, state, state)])

    def _compared(self, controller: Controller, context: Context) -> Compared | None:
        """The outputs of a controller and what they should be; None if nobody says."""
        own = controller.GetMyContextFromRoot(context)
        return controller.compared(own, self._shown(context))

    def _shown(self, context: Context) -> Callable[[str], FloatArray]:
        """What the plant shows now, by the names that a record has; empty for nothing."""
        plant = self._plants[0]
        own = plant.GetMyContextFromRoot(context)

        def value(name: str) -> FloatArray:
            if name == "state":
                return plant.state(own)
            if name != "control":
                return np.array(plant.GetOutputPort(name).Eval(own))
            port = plant.GetInputPort("control")
            if port.HasValue(own):
                return np.array(port.Eval(own))
            # A law that is fed back as a value.
            is_known = self._diagram.HasOutputPort("control")
            return np.array(
                self._diagram.GetOutputPort("control").Eval(context) if is_known else []
            )

        return value


class RecordWatch:
    """`DivergenceWatch` for a run of which only rows of its record are seen, in their order.

    Args:
        plant: The plant.
        duration: How long the run lasts, in s.
    """

    def __init__(self, plant: Plant, duration: float) -> None:
        self._plant, self._duration = plant, duration
        self._watched: tuple[_Amounts, _Amounts, _Errors] | None = None

    def look(self, record: Record) -> None:
        """Looks at rows that follow those that were looked at.

        Raises:
            SimulationError: The run diverges; the time is that of the first row that says so.
        """
        if not record.time.size:
            return
        states, outputs = record["state"], record["controlled_output"]
        if self._watched is None:
            signals, time = record.signals["controlled_output"].signals, float(record.time[0])
            start = _sizes(self._plant, lambda name: record[name][0])
            window = WINDOW * self._duration
            self._watched = (
                _Amounts.states(self._plant, time, states[0]),
                _Amounts.controls(self._plant, time, start),
                _Errors(signals, time, window, start, _least(self._plant)),
            )
        of_states, of_controls, of_errors = self._watched
        found = [
            of_errors.look(record.time, outputs, record["desired_output"], states),
            of_states.look(record.time, states, states),
            of_controls.look(record.time, record["control"], states),
        ]
        _raise_first(found)


Sizes = dict[str, float]
"""Unit -> the largest number in it."""


def _sizes(plant: Plant, shown: Callable[[str], FloatArray]) -> Sizes:
    """The largest numbers in each unit of a plant's signals."""
    found: Sizes = {}
    dae = plant.dae
    for name, signals in (
        ("state", dae.state_signals),
        ("controlled_output", dae.output_signals),
        ("constraint_force", dae.force_signals),
        ("control", dae.control_signals),
    ):
        found = _with(found, signals, shown(name))
    return found


def _least(plant: Plant) -> Sizes:
    """Sizes of their own: a turn of one radian, the axis of a robot's frame."""
    return {"rad": 1.0} if plant.model is None else {"rad": 1.0, "": 1.0}


def _with(sizes: Sizes, signals: Sequence[Signal], values: FloatArray) -> Sizes:
    found = dict(sizes)
    for signal, value in zip(signals, values, strict=False):
        if np.isfinite(value):
            found[signal.unit] = max(found.get(signal.unit, 0.0), abs(float(value)))
    return found


class _Amounts:
    """The states, or the controls, of a plant beside their sizes."""

    def __init__(self, signals: Sequence[Signal], time: float, size: FloatArray) -> None:
        self._signals, self._since, self._size = signals, time, size

    @classmethod
    def states(cls, plant: Plant, time: float, start: FloatArray) -> Self:
        """Those of its states."""
        return cls(plant.dae.state_signals, time, np.maximum(plant.dae.scale, np.abs(start)))

    @classmethod
    def controls(cls, plant: Plant, time: float, sizes: Sizes) -> Self:
        """Those of its controls; of a unit in which nothing has a size none is watched."""
        found = [sizes.get(signal.unit, 0.0) or np.inf for signal in plant.dae.control_signals]
        return cls(plant.dae.control_signals, time, np.array(found))

    def look(
        self, times: FloatArray, values: FloatArray, states: FloatArray
    ) -> SimulationError | None:
        """What diverges first in rows of a run; None if nothing does."""
        shares = np.abs(values) / self._size
        largest = shares.max(axis=1, initial=0.0)
        if largest[-1] <= 10.0 and not largest.max() > BEYOND:
            self._since = times[-1]
            return None
        beyond = np.flatnonzero(largest > BEYOND)
        row = int(beyond[0]) if beyond.size else len(times) - 1
        small = np.flatnonzero(largest[: row + 1] <= 10.0)
        self._since = float(times[small[-1]]) if small.size else self._since
        if not beyond.size:
            return None
        worst = int(np.argmax(shares[row]))
        signal = self._signals[worst]
        return _diverged(
            f"{_amount(signal, values[row, worst])}, {shares[row, worst]:.2g} times the "
            f"{_quantity(self._size[worst], signal)} that it is large in use",
            (self._since, float(times[row])),
            states[row],
        )


class _Errors:
    """The errors of outputs beside their sizes."""

    def __init__(
        self, signals: Sequence[Signal], time: float, window: float, sizes: Sizes, least: Sizes
    ) -> None:
        self._signals, self._time, self._window = signals, time, window
        self._largest = max(sizes.values(), default=0.0)
        self._sizes = sizes | {
            unit: max(size, sizes.get(unit, 0.0)) for unit, size in least.items()
        }
        self._mean, self._since = np.zeros(len(signals)), np.full(len(signals), time)

    def look(
        self, times: FloatArray, outputs: FloatArray, desired: FloatArray, states: FloatArray
    ) -> SimulationError | None:
        """What diverges first in rows of a run; None if nothing does."""
        sizes = self._along(desired)
        errors = np.abs(outputs - desired)
        least = KNOWN * np.maximum(self._largest, sizes.max(axis=1, initial=0.0, keepdims=True))
        shares = np.divide(errors, sizes, out=np.zeros_like(errors), where=sizes > least)
        if (shares <= 1.0).all():
            self._mean *= np.exp((self._time - times[-1]) / self._window)
            self._since[:] = self._time = times[-1]
            return None
        held = -np.expm1(-np.diff(times, prepend=self._time) / self._window)
        logs = np.log(np.maximum(shares, 1.0))
        for row, time in enumerate(times.tolist()):
            self._mean += held[row] * (logs[row] - self._mean)
            self._since[shares[row] <= 1.0] = self._time = time
            beyond = (self._mean > np.log(LASTING)) | (shares[row] > ENORMOUS)
            if not beyond.any():
                continue
            worst = int(np.argmax(np.where(beyond, shares[row], 0.0)))
            signal, size = self._signals[worst], sizes[row, worst]
            error = outputs[row, worst] - desired[row, worst]
            return _diverged(
                f"the error of {_amount(signal, error)}, {shares[row, worst]:.2g} times the "
                f"{_quantity(size, signal)} that was asked for or was there at the start",
                (float(self._since[worst]), time),
                states[row],
            )

        return None

    def _along(self, desired: FloatArray) -> FloatArray:
        """The sizes of all outputs at each time, from what was desired up to then."""
        units, found = [signal.unit for signal in self._signals], np.zeros_like(desired)
        for unit in dict.fromkeys(units):
            own = np.array([each == unit for each in units])
            largest = np.nan_to_num(np.abs(desired[:, own]), nan=0.0, posinf=0.0).max(axis=1)
            grown = np.maximum.accumulate(np.maximum(largest, self._sizes.get(unit, 0.0)))
            self._sizes[unit] = float(grown[-1])
            found[:, own] = grown[:, None]
        return found


def _blocks(system: System) -> Iterator[System]:
    """The blocks of a diagram; a plant or a controller that is a diagram is one block."""
    if isinstance(system, Diagram) and not isinstance(system, Plant | Controller):
        for block in system.GetSystems():
            yield from _blocks(block)
    else:
        yield system


def _raise_first(found: Sequence[SimulationError | None]) -> None:
    if errors := [error for error in found if error is not None]:
        raise min(errors, key=lambda error: error.time)


def _quantity(value: float, signal: Signal) -> str:
    return f"{value:.3g} {signal.unit}".rstrip()


def _amount(signal: Signal, value: float) -> str:
    return f"{signal.name} is {_quantity(value, signal)}"


def _diverged(what: str, times: tuple[float, float], state: FloatArray) -> SimulationError:
    since, time = times
    return SimulationError(
        f"the run diverges: at t = {time:.6g} s {what}, and it has grown since {since:.4g} s. The "
        "loop is unstable, or the robot cannot do what is asked: choose slower gains, a shorter "
        "period and delay of the law, or a plant that is nearer to the law's model. With "
        "may_diverge the run goes on all the same",
        time,
        state,
    )
