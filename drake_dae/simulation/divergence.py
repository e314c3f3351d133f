"""Runs that end where they diverge, with what grew and since when."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.errors import SimulationError
from drake_dae.simulation.growth import WINDOW, ErrorGrowth, Sizes, StateGrowth, with_sizes
from drake_dae.simulation.records.record import Record
from drake_dae.systems.control.contract import Compared, Controller
from drake_dae.systems.plants.contract import Plant

EVERY = 32
"""After so many steps one is looked at: an output is computed for it."""


class DivergenceWatch:
    """Ends a run whose states or errors leave all measure.

    A state is compared with its value at the start and with `DaeSystem.scale`, a control at the end
    with what had its unit at the start: before, as near a singular configuration, the run ends by
    itself, and tells why. The error z - r of
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
            StateGrowth.states(plant, time, plant.state(plant.GetMyContextFromRoot(context)))
            for plant in self._plants
        ]
        self._errors: list[tuple[Controller, ErrorGrowth]] = []
        self._controls: StateGrowth | None = None
        for controller in self._controllers:
            plant = self._plants[0]
            start = _sizes(plant, self._shown(context))
            self._controls = StateGrowth.controls(plant, time, start)
            if (now := self._compared(controller, context)) is None:
                continue
            sizes, window = with_sizes(start, now[2], now[0]), WINDOW * duration
            errors = ErrorGrowth(now[2], time, window, sizes, _least(plant))
            self._errors.append((controller, errors))

    @property
    def sees(self) -> bool:
        """Whether there is anything to watch."""
        return bool(self._states)

    def look(self, context: Context, *, always: bool = False) -> None:
        """Looks at an accepted step, at some of them.

        Args:
            context: The context of the diagram.
            always: Whether to look at this one, the last.

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
            error = self._controls.look(times, control, state)
            _raise_first([error] if always else [])
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
        self._watched: tuple[StateGrowth, StateGrowth, ErrorGrowth] | None = None

    def look(self, record: Record, *, is_last: bool = False) -> None:
        """Looks at rows that follow those that were looked at.

        Args:
            record: The rows.
            is_last: Whether the run has come to its end with them.

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
                StateGrowth.states(self._plant, time, states[0]),
                StateGrowth.controls(self._plant, time, start),
                ErrorGrowth(signals, time, window, start, _least(self._plant)),
            )
        of_states, of_controls, of_errors = self._watched
        controls = of_controls.look(record.time, record["control"], states)
        errors = [
            of_errors.look(record.time, outputs, record["desired_output"], states),
            of_states.look(record.time, states, states),
        ]
        _raise_first([*errors, controls] if is_last else errors)


def _sizes(plant: Plant, shown: Callable[[str], FloatArray]) -> Sizes:
    """The largest numbers in each unit of a plant's signals."""
    sizes: Sizes = {}
    dae = plant.dae
    for name, signals in (
        ("state", dae.state_signals),
        ("controlled_output", dae.output_signals),
        ("constraint_force", dae.force_signals),
        ("control", dae.control_signals),
    ):
        sizes = with_sizes(sizes, signals, shown(name))
    return sizes


def _least(plant: Plant) -> Sizes:
    """Sizes of their own: a turn of one radian, the axis of a robot's frame."""
    return {"rad": 1.0} if plant.model is None else {"rad": 1.0, "": 1.0}


def _blocks(system: System) -> Iterator[System]:
    """The blocks of a diagram; a plant or a controller that is a diagram is one block."""
    if isinstance(system, Diagram) and not isinstance(system, Plant | Controller):
        for block in system.GetSystems():
            yield from _blocks(block)
    else:
        yield system


def _raise_first(candidates: Sequence[SimulationError | None]) -> None:
    if errors := [error for error in candidates if error is not None]:
        raise min(errors, key=lambda error: error.time)
