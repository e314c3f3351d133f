"""The plant of a loop, driven by recorded controls, with exact derivatives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, OutputPort, System

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compile import compile_open
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.wires import Wires
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.stepping.many import VectorizedFunction
from drake_dae.systems.plants.contract import Plant

HALVES = (0.0, 0.5, 0.5, 1.0)
"""The times of the stages of the fourth-order Runge-Kutta method, in steps."""

WEIGHTS = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)


class MovedPieces(NamedTuple):
    """Values of many pieces at one time, and their derivatives.

    Attributes:
        values: The values, shape (j, k).
        slopes: Their derivatives with respect to the initial state and to the unknown parameters,
            shape (j, k, n + p); None if they are not computed.
    """

    values: FloatArray
    slopes: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class DrivenPlant:
    """The plant of a loop as functions of its state, its control and some of its parameters.

    A continuous plant is integrated by the classical Runge-Kutta method of fourth order, a discrete
    plant by its own steps; its state is the whole discrete state. A plant with unilateral contacts
    has one further control for each of them, the mode: 1 closed, 0 open, constant during a step.

    Attributes:
        loop: The loop.
        context: A context of its diagram, with the values of all parameters.
        outputs: Name -> output port that is evaluated.
        places: The indices of the unknown parameters in numeric parameter 0 of the plant.
    """

    loop: ClosedLoop
    context: Context
    outputs: Mapping[str, OutputPort]
    places: Sequence[int]

    def __post_init__(self) -> None:
        compiled, plant = self._compiled, self.loop.plant
        if compiled.has_stepped:
            raise ModelError(
                f"{plant.dae.name} is stepped by Drake's own contact, which has no derivatives; "
                "take point contact as !CompliantContact"
            )
        size = sum(part.stop - part.start for system, part in compiled.held if system is plant)
        is_mixed = bool(size and compiled.sizes["state"])  # Contacts keep their mode beside x.
        if size != compiled.sizes["held"] or (is_mixed and not plant.contacts) or compiled.watched:
            raise ModelError(f"{plant.dae.name}: a plant that samples cannot be identified")

    @cached_property
    def _compiled(self) -> CompiledDiagram:
        return compile_open(
            self.loop.diagram, [self.loop.plant.GetInputPort("control")], self.outputs
        )

    @property
    def period(self) -> float:
        """The step of a discrete plant, in s; 0 for a continuous one."""
        return self.loop.plant.time_step

    @cached_property
    def lag(self) -> float:
        """The time constant of the force sensor in s; 0 for none."""
        return 0.0 if self.loop.sensor is None else self.loop.sensor.time_constant

    @cached_property
    def felt(self) -> slice:
        """The indices of the force sensor's states, the last ones; empty without a lag."""
        size = len(self.loop.sensor.bias) if self.lag and self.loop.sensor is not None else 0
        first = int(self._compiled.sizes["held" if self.period else "state"])
        return slice(first, first + size)

    @property
    def num_states(self) -> int:
        """n, the number of states of the plant and of a force sensor with a lag."""
        return self.felt.stop

    @cached_property
    def state_of_plant(self) -> slice:
        """The indices of the plant's state."""
        places = self._compiled.held if self.period else self._compiled.states
        return dict(places)[self.loop.plant]

    @cached_property
    def scale(self) -> FloatArray:
        """The sizes of the states, shape (n,)."""
        scale, of_plant = np.ones(self.num_states), self.loop.plant.dae.scale
        first = self.state_of_plant.start
        scale[first : first + of_plant.size] = of_plant
        return scale

    @cached_property
    def base(self) -> FloatArray:
        """The values of all parameters of the functions in the context."""
        compiled, context = self._compiled, self.context.Clone()
        for system, name, _ in compiled.fixed:
            port = system.GetInputPort(name)
            port.FixValue(system.GetMyMutableContextFromRoot(context), np.zeros(port.size()))
        return compiled.values(context)

    @cached_property
    def nominal(self) -> FloatArray:
        """The values of the unknown parameters in the context, shape (p,)."""
        return self.base[self._unknown]

    @cached_property
    def _unknown(self) -> list[int]:
        first = dict(self._compiled.parameters)[self.loop.plant].start if self.places else 0
        return [first + place for place in self.places]

    @cached_property
    def hold(self) -> System | None:
        """The zero-order hold of the control; None if there is none."""
        return control_hold(self.loop.plant, Wires.of(self.loop.diagram))

    @cached_property
    def names(self) -> Sequence[str]:
        """The names of the `evaluated` outputs; a lag of the force sensor adds "felt_force"."""
        return (*self._compiled.outputs, *(("felt_force",) if self.lag else ()))

    @cached_property
    def output_places(self) -> dict[str, slice]:
        """Name of an output -> its entries in `evaluated`."""
        sizes = [self.outputs[name].size() for name in self._compiled.outputs]
        ends = np.cumsum([*sizes, self.felt.stop - self.felt.start]).tolist()
        return {
            name: slice(first, end)
            for name, first, end in zip(self.names, [0, *ends], ends, strict=False)
        }

    @cached_property
    def _symbols(self) -> list[ca.SX]:
        plant = self.loop.plant
        sizes = {
            "time": 1,
            "state": self.num_states,
            "unknown": len(self.places),
            "control": plant.GetInputPort("control").size() + len(plant.contacts),
            "base": self._compiled.sizes["parameters"],
        }
        return [ca.SX.sym(name, size) for name, size in sizes.items()]

    def _arguments(self) -> list[ca.SX]:
        """The arguments of the diagram's functions, as expressions of the symbols."""
        time, state, unknown, control, base = self._symbols
        compiled, values = self._compiled, ca.SX(base)
        if self.places:
            values[self._unknown] = unknown
        for system, name, part in compiled.fixed:
            if name == "control" and system is self.loop.plant:
                values[part] = control[: part.stop - part.start]
        return self._arguments_at(time, state[: self.felt.start], values)

    def _arguments_at(self, time: ca.SX, state: ca.SX, values: ca.SX) -> list[ca.SX]:
        control = self._symbols[3]
        mode = control[control.numel() - len(self.loop.plant.contacts) :]
        return [time, *((ca.SX(0, 1), state) if self.period else (state, mode)), values]

    def _force(self, arguments: list[ca.SX]) -> ca.SX:
        """The input of the force sensor: the multipliers."""
        first, size = self.output_places["constraint_force"].start, self.felt.stop - self.felt.start
        return self._compiled.row.call(arguments)[0][first : first + size]

    def _functions(
        self, value: ca.SX, valid: ca.SX
    ) -> tuple[VectorizedFunction, VectorizedFunction]:
        """The function of a value, and one with derivatives by state and unknown parameters too."""
        by = ca.vertcat(self._symbols[1], self._symbols[2])
        shown = ca.densify(value) + 0.0 * valid
        slopes = ca.densify(ca.vec(ca.jacobian(value, by).T))
        plain, full = (
            VectorizedFunction(ca.Function("driven", self._symbols, ca.cse(values), {"cse": False}))
            for values in ([shown], [shown, slopes])
        )
        return plain, full

    @cached_property
    def _moves(self) -> tuple[VectorizedFunction, VectorizedFunction]:
        """The derivative of the state, or the next state of a discrete plant."""
        compiled, arguments = self._compiled, self._arguments()
        felt = self._symbols[1][self.felt]
        if not self.period:
            rate, valid = compiled.rate.call(arguments)
            if self.lag:
                rate = ca.vertcat(rate, (self._force(arguments) - felt) / self.lag)
            return self._functions(rate, valid)
        (update,) = compiled.rates
        noise = ca.SX.zeros(compiled.sizes["noise"])
        values, valid = update.function.call([*arguments, noise])
        state = ca.SX(self._symbols[1][: self.felt.start])
        state[list(update.places)] = values
        if self.lag:
            # The force of a step acts on the sensor during the next one.
            time, parameters = arguments[0], arguments[-1]
            force = self._force(self._arguments_at(time + self.period, state, parameters))
            decay = float(np.exp(-self.period / self.lag))
            state = ca.vertcat(state, force + decay * (felt - force))
        return self._functions(state, valid)

    @cached_property
    def _outputs(self) -> tuple[VectorizedFunction, VectorizedFunction]:
        row, valid = self._compiled.row.call(self._arguments())
        return self._functions(ca.vertcat(row, self._symbols[1][self.felt]), valid)

    def _called(
        self,
        functions: tuple[VectorizedFunction, VectorizedFunction],
        time: FloatArray,
        moved: MovedPieces,
        unknown: FloatArray,
        control: FloatArray,
    ) -> MovedPieces:
        """Evaluates a function at many states, with derivatives by the chain rule."""
        plain, full = functions
        arguments = time[:, None], moved.values, unknown, control, self.base
        if moved.slopes is None:
            return MovedPieces(plain(*arguments)[0])
        (count, n), (values, flat) = moved.values.shape, full(*arguments)
        local = flat.reshape(count, -1, n + unknown.size)
        with np.errstate(all="ignore"):  # The caller checks that values are finite.
            slopes = np.matmul(local[:, :, :n], moved.slopes)
        slopes[:, :, n:] += local[:, :, n:]
        return MovedPieces(values, slopes)

    def initial(self, states: FloatArray) -> MovedPieces:
        """The initial states of pieces, shape (j, n), with the identity as derivatives."""
        count, n = states.shape
        slopes = np.zeros((count, n, n + len(self.places)))
        slopes[:] = np.eye(n, n + len(self.places))
        return MovedPieces(states, slopes)

    def evaluated(
        self, time: FloatArray, moved: MovedPieces, unknown: FloatArray, control: FloatArray
    ) -> MovedPieces:
        """The outputs `names`, stacked.

        Args:
            time: The times in s, shape (j,).
            moved: The states.
            unknown: The unknown parameters, shape (p,).
            control: The controls, followed by the modes of the contacts, shape (j, q).
        """
        return self._called(self._outputs, time, moved, unknown, control)

    def step(
        self,
        time: FloatArray,
        after: FloatArray,
        moved: MovedPieces,
        unknown: FloatArray,
        controls: Sequence[FloatArray],
    ) -> MovedPieces:
        """Integrates the states from `time` to `after`.

        Args:
            time, after: The initial and final times in s, shape (j,).
            moved: The states at `time`.
            unknown: The unknown parameters, shape (p,).
            controls: Arrays of shape (j, q). A discrete plant has one for each step; a continuous
                plant has one for each end and each middle of its equal steps.
        """
        if self.period:
            for index, control in enumerate(controls):
                moved = self._called(
                    self._moves, time + index * self.period, moved, unknown, control
                )
            return moved
        count = len(controls) // 2
        h = (after - time) / count
        for index in range(count):
            own = controls[2 * index : 2 * index + 3]
            moved = self._runge_kutta(time + index * h, h, moved, unknown, own)
        return moved

    def _runge_kutta(
        self,
        time: FloatArray,
        h: FloatArray,
        moved: MovedPieces,
        unknown: FloatArray,
        controls: Sequence[FloatArray],
    ) -> MovedPieces:
        stage, rates = moved, list[MovedPieces]()
        for half in HALVES:
            if half:
                stage = _ahead(moved, half * h, rates[-1:], (1.0,))
            control = controls[int(2 * half)]
            rates.append(self._called(self._moves, time + half * h, stage, unknown, control))
        return _ahead(moved, h, rates, WEIGHTS)


def _ahead(
    moved: MovedPieces, h: FloatArray, rates: Sequence[MovedPieces], weights: Sequence[float]
) -> MovedPieces:
    """Adds h times the weighted sum of the rates."""
    values, slopes = moved
    for weight, rate in zip(weights, rates, strict=True):
        values = values + (weight * h)[:, None] * rate.values
        if slopes is not None and rate.slopes is not None:
            slopes = slopes + (weight * h)[:, None, None] * rate.slopes
    return MovedPieces(values, slopes)


def control_hold(plant: Plant, wires: Wires) -> System | None:
    """Returns the zero-order hold of a plant's control; None if there is none."""
    port = plant, int(plant.GetInputPort("control").get_index())
    while (source := wires.sources.get(port)) is not None:
        system, index = source
        if not system.HasDirectFeedthrough(index):
            return system if not system.num_continuous_states() else None
        if system.num_input_ports() != 1:
            return None
        port = system, 0
    return None
