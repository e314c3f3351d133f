"""Runs that end where they diverge, with what grew and since when."""

from collections.abc import Iterator, Sequence

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.plants.contract import Plant

LASTING = 100.0
"""An error that is so many times the size of its output, on average over the `WINDOW`, diverges."""

ENORMOUS = 1e6
"""An error that is so many times the size of its output diverges at once."""

BEYOND = 1e9
"""A state that is so many times its size diverges at once. A joint that turns all day does not."""

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

    A state is compared with its value at the start and with `DaeSystem.scale`. The error z - r of
    an output is compared with the largest number in its unit that the reference has had up to now,
    or that outputs, states, forces and controls had at the start. So nothing depends on units, and
    the force of an impact, the sag under a load or a start far away are no divergence.

    Args:
        diagram: What runs: each `Plant` in it is watched, and the errors of a `Controller` that
            reads references, where one plant is there.
        context: Its context at the start of the run.
        duration: How long the run lasts, in s.
    """

    def __init__(self, diagram: System, context: Context, duration: float) -> None:
        blocks = list(_blocks(diagram))
        plants = [block for block in blocks if isinstance(block, Plant)]
        self._states = [_States(plant, context) for plant in plants]
        self._errors = [
            _Errors(plants[0], block, context, WINDOW * duration)
            for block in blocks
            if isinstance(block, Controller)
            and len(plants) == 1
            and block.law.system.num_outputs == plants[0].dae.num_outputs > 0
            and _reference(block, diagram, context) is not None
        ]
        self._diagram, self._steps = diagram, 0

    @property
    def sees(self) -> bool:
        """Whether there is anything to watch."""
        return bool(self._states)

    def look(self, context: Context) -> None:
        """Looks at an accepted step, at some of them.

        Args:
            context: The context of the diagram.

        Raises:
            SimulationError: The run diverges.
        """
        self._steps += 1
        if self._steps % EVERY:
            return
        for states in self._states:
            states.look(context)
        for errors in self._errors:
            errors.look(context, self._diagram)


class _States:
    """The states of a plant beside their sizes."""

    def __init__(self, plant: Plant, context: Context) -> None:
        self._plant, self._since = plant, context.get_time()
        self._size = np.maximum(plant.dae.scale, np.abs(self._value(context)))

    def _value(self, context: Context) -> FloatArray:
        return self._plant.state(self._plant.GetMyContextFromRoot(context))

    def look(self, context: Context) -> None:
        state = self._value(context)
        shares = np.abs(state) / self._size
        largest = shares.max(initial=0.0)
        if largest <= 10.0:
            self._since = context.get_time()
        if not largest > BEYOND:
            return
        worst = int(np.argmax(shares))
        signal = self._plant.dae.state_signals[worst]
        raise _diverged(
            f"{_amount(signal, state[worst])}, {shares[worst]:.2g} times the "
            f"{_quantity(self._size[worst], signal)} that it is large in use",
            (self._since, context.get_time()),
            state,
        )


class _Errors:
    """The errors of the outputs of a plant beside their sizes."""

    def __init__(
        self, plant: Plant, controller: Controller, context: Context, window: float
    ) -> None:
        dae, at_plant = plant.dae, plant.GetMyContextFromRoot(context)
        self._plant, self._controller, self._window = plant, controller, window
        self._output, self._signals = plant.GetOutputPort("controlled_output"), dae.output_signals
        self._lowest = controller.law.layout.lowest
        self._sizes: dict[str, float] = {}
        control = plant.GetInputPort("control")
        starts = [
            (dae.state_signals, plant.state(at_plant)),
            (dae.output_signals, self._output.Eval(at_plant)),
            (dae.force_signals, plant.GetOutputPort("constraint_force").Eval(at_plant)),
        ]
        if control.HasValue(at_plant):
            starts.append((dae.control_signals, control.Eval(at_plant)))
        for signals, values in starts:
            self._note(signals, values)
        self._largest = max(self._sizes.values(), default=0.0)
        # A turn of one radian is a size of its own.
        self._sizes["rad"] = max(1.0, self._sizes.get("rad", 0.0))
        self._time = context.get_time()
        self._mean = np.zeros(dae.num_outputs)
        self._since = np.full(dae.num_outputs, self._time)

    def _note(self, signals: Sequence[Signal], values: FloatArray) -> None:
        for signal, value in zip(signals, values, strict=True):
            if np.isfinite(value):
                self._sizes[signal.unit] = max(self._sizes.get(signal.unit, 0.0), abs(value))

    def look(self, context: Context, diagram: System) -> None:
        wanted = _reference(self._controller, diagram, context)
        if wanted is None:
            return
        desired, at_plant = wanted[self._lowest], self._plant.GetMyContextFromRoot(context)
        self._note(self._signals, desired)
        error = self._output.Eval(at_plant) - desired
        sizes = np.array([self._sizes[signal.unit] for signal in self._signals])
        known = sizes > KNOWN * max(self._largest, float(np.max(sizes)))
        shares = np.abs(error[known]) / sizes[known]
        time = context.get_time()
        held = -np.expm1((self._time - time) / self._window)
        self._time = time
        mean = self._mean[known]
        mean += held * (np.log(np.maximum(shares, 1.0)) - mean)
        self._mean[known] = mean
        since = self._since[known]
        since[shares <= 1.0] = time
        self._since[known] = since
        beyond = (mean > np.log(LASTING)) | (shares > ENORMOUS)
        if not beyond.any():
            return
        worst = int(np.flatnonzero(known)[np.argmax(np.where(beyond, shares, 0.0))])
        signal, size = self._signals[worst], sizes[worst]
        raise _diverged(
            f"the error of {_amount(signal, error[worst])}, {abs(error[worst]) / size:.2g} times "
            f"the {_quantity(size, signal)} that was asked for or was there at the start",
            (float(self._since[worst]), time),
            self._plant.state(at_plant),
        )


def _blocks(system: System) -> Iterator[System]:
    """The blocks of a diagram; a plant or a controller that is a diagram is one block."""
    if isinstance(system, Diagram) and not isinstance(system, Plant | Controller):
        for block in system.GetSystems():
            yield from _blocks(block)
    else:
        yield system


def _reference(controller: Controller, diagram: System, context: Context) -> FloatArray | None:
    """R of a controller; None where nobody tells it."""
    own = controller.GetMyContextFromRoot(context)
    if controller.HasInputPort("reference"):
        port = controller.GetInputPort("reference")
        if port.HasValue(own):
            return np.array(port.Eval(own))
    if diagram.HasOutputPort("reference"):
        found = np.array(diagram.GetOutputPort("reference").Eval(context))
        return found if found.size == controller.law.layout.reference_size else None
    return None


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
