"""Detection of runs that diverge: which state, control or error grew, and since when."""

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
"""The number of steps from one check to the next, since each check evaluates output ports."""


class DivergenceWatch:
    """Raises an error if the states, controls or tracking errors of a run grow beyond all bounds.

    A state is compared with its initial value and with `DaeSystem.scale`. The tracking error z - r
    of an output is compared with the largest value of the reference up to now, and of outputs,
    states, forces and controls at the start, in the same unit. A control is compared with the
    initial values in its unit, and only at the end of the run: if it is large before, as near a
    singular configuration, the run fails with a better message. So no verdict depends on units, and
    the force of an impact, the sag under a payload or a distant start are not divergence.

    Args:
        diagram: The diagram. Each `Plant` in it is checked, and the errors of each `Controller` if
            there is exactly one plant.
        context: Its context at the start of the run.
        duration: The duration of the run, in s.
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
            start = _sizes(plant, self._signals(context))
            self._controls = StateGrowth.controls(plant, time, start)
            if (now := self._compared(controller, context)) is None:
                continue
            sizes, window = with_sizes(start, now[2], now[0]), WINDOW * duration
            errors = ErrorGrowth(now[2], time, window, sizes, _least(plant))
            self._errors.append((controller, errors))

    @property
    def sees(self) -> bool:
        """Whether there is a plant to check."""
        return bool(self._states)

    def look(self, context: Context, steps: int = 1, *, always: bool = False) -> None:
        """Checks an accepted step; of consecutive steps only every 32nd is checked.

        Args:
            context: The context of the diagram.
            steps: The number of steps since the last call.
            always: Whether this step is checked in any case, since it is the last.

        Raises:
            SimulationError: The run diverges.
        """
        self._steps += steps
        if self._steps % EVERY and not always:
            return
        self.look_at_states(context)
        if not self._controllers:
            return
        times, signal = np.array([context.get_time()]), self._signals(context)
        state, control = signal("state")[None], signal("control")[None]
        if self._controls is not None and control.size:
            error = self._controls.look(times, control, state)
            _raise_first([error] if always else [])
        for controller, errors in self._errors:
            if (now := self._compared(controller, context)) is not None:
                _raise_first([errors.look(times, now[0][None], now[1][None], state)])

    def look_at_states(self, context: Context) -> None:
        """Checks only the states, since outputs may have no values after the failure of a run.

        Raises:
            SimulationError: They diverge.
        """
        times = np.array([context.get_time()])
        for plant, amounts in zip(self._plants, self._states, strict=True):
            state = plant.state(plant.GetMyContextFromRoot(context))[None]
            _raise_first([amounts.look(times, state, state)])

    def _compared(self, controller: Controller, context: Context) -> Compared | None:
        """The outputs of a controller and their references; None if it does not compare any."""
        at_controller = controller.GetMyContextFromRoot(context)
        return controller.compared(at_controller, self._signals(context))

    def _signals(self, context: Context) -> Callable[[str], FloatArray]:
        """A function from names of recorded signals to their present values; empty if unknown."""
        plant = self._plants[0]
        at_plant = plant.GetMyContextFromRoot(context)

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

        return value


class RecordWatch:
    """`DivergenceWatch` for a run whose record is checked, part by part.

    Args:
        plant: The plant.
        duration: The duration of the run, in s.
    """

    def __init__(self, plant: Plant, duration: float) -> None:
        self._plant, self._duration = plant, duration
        self._watched: tuple[StateGrowth, StateGrowth, ErrorGrowth] | None = None

    def look(self, record: Record, *, is_last: bool = False) -> None:
        """Checks the next rows of a record.

        Args:
            record: The rows.
            is_last: Whether the run ends with them.

        Raises:
            SimulationError: The run diverges; with the time of the first row that shows it.
        """
        if not record.time.size:
            return
        states, outputs = record["state"], record["controlled_output"]
        if self._watched is None:
            self._watched = _growths(self._plant, record, self._duration)
        of_states, of_controls, of_errors = self._watched
        controls = of_controls.look(record.time, record["control"], states)
        errors = [
            of_errors.look(record.time, outputs, record["desired_output"], states),
            of_states.look(record.time, states, states),
        ]
        _raise_first([*errors, controls] if is_last else errors)


def _growths(
    plant: Plant, record: Record, duration: float
) -> tuple[StateGrowth, StateGrowth, ErrorGrowth]:
    """The growth of states, controls and errors, from the first row of a record on."""
    signals, time = record.signals["controlled_output"].signals, float(record.time[0])
    start = _sizes(plant, lambda name: record[name][0])
    return (
        StateGrowth.states(plant, time, record["state"][0]),
        StateGrowth.controls(plant, time, start),
        ErrorGrowth(signals, time, WINDOW * duration, start, _least(plant)),
    )


def _sizes(plant: Plant, value: Callable[[str], FloatArray]) -> Sizes:
    """The largest numbers in each unit of a plant's signals."""
    sizes: Sizes = {}
    dae = plant.dae
    for name, signals in (
        ("state", dae.state_signals),
        ("controlled_output", dae.output_signals),
        ("constraint_force", dae.force_signals),
        ("control", dae.control_signals),
    ):
        sizes = with_sizes(sizes, signals, value(name))
    return sizes


def _least(plant: Plant) -> Sizes:
    """The least sizes in some units: one radian; the length 1 of an axis of a robot's frame."""
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
