"""The plant of a loop alone, driven by recorded controls, with exact derivatives."""

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
"""When the stages of the fourth-order Runge-Kutta method are, in steps."""

WEIGHTS = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)


class MovedPieces(NamedTuple):
    """Values at one moment of many pieces, and how they depend on where these begin.

    Attributes:
        values: Shape (j, k).
        slopes: Their derivatives with respect to the state at the beginning and to the unknown
            parameters, shape (j, k, n + p); None where nobody asks for them.
    """

    values: FloatArray
    slopes: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class DrivenPlant:
    """The plant of a loop as functions of its state, its control and some of its parameters.

    A continuous plant takes steps of the classical Runge-Kutta method of fourth order, a discrete
    one its own. The state of a discrete plant is all that it holds. A plant whose contacts open
    takes for each of them 1 or 0 as a further entry of its control: whether it is closed, which
    stays as it is while the plant moves.

    Attributes:
        loop: The loop.
        context: A context of its diagram, with the values of all parameters.
        outputs: Name -> the output port whose values are of interest.
        places: The places of the unknown parameters in numeric parameter 0 of the plant.
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
        own = sum(part.stop - part.start for system, part in compiled.held if system is plant)
        is_known = bool(plant.contacts) or not (own and compiled.sizes["state"])
        if own != compiled.sizes["held"] or not is_known or compiled.watched:
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
        """The states of the force sensor, which come last; empty without a lag."""
        size = len(self.loop.sensor.bias) if self.lag and self.loop.sensor is not None else 0
        first = int(self._compiled.sizes["held" if self.period else "state"])
        return slice(first, first + size)

    @property
    def num_states(self) -> int:
        """n, those of the plant and then those of a force sensor with a lag."""
        return self.felt.stop

    @cached_property
    def state_of_plant(self) -> slice:
        """Where the state of the plant stands."""
        places = self._compiled.held if self.period else self._compiled.states
        return dict(places)[self.loop.plant]

    @cached_property
    def scale(self) -> FloatArray:
        """The sizes of the states, shape (n,)."""
        found = np.ones(self.num_states)
        x = self.loop.plant.dae.scale
        first = self.state_of_plant.start
        found[first : first + x.size] = x
        return found

    @cached_property
    def base(self) -> FloatArray:
        """All parameters of the functions, with the values of the context."""
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
        """The block that holds the control between samples; None if there is none."""
        return control_hold(self.loop.plant, Wires.of(self.loop.diagram))

    @cached_property
    def names(self) -> Sequence[str]:
        """The outputs in the order of `seen`; last "felt_force" of a sensor with a lag."""
        own = ("felt_force",) if self.lag else ()
        return (*self._compiled.outputs, *own)

    @cached_property
    def sizes(self) -> Sequence[int]:
        """The number of entries of each output."""
        own = [self.felt.stop - self.felt.start] if self.lag else []
        return [*(self.outputs[name].size() for name in self._compiled.outputs), *own]

    @cached_property
    def _symbols(self) -> list[ca.SX]:
        sizes = self._compiled.sizes
        plant = self.loop.plant
        control = plant.GetInputPort("control").size() + len(plant.contacts)
        given = {"time": 1, "state": self.num_states, "unknown": len(self.places)}
        given |= {"control": control, "base": sizes["parameters"]}
        return [ca.SX.sym(name, size) for name, size in given.items()]

    def _arguments(self) -> list[ca.SX]:
        """What the functions of the diagram take."""
        time, state, unknown, control, base = self._symbols
        compiled, values = self._compiled, ca.SX(base)
        if self.places:
            values[self._unknown] = unknown
        for system, name, part in compiled.fixed:
            if name == "control" and system is self.loop.plant:
                values[part] = control[: part.stop - part.start]
        return self._given(time, state[: self.felt.start], values)

    def _given(self, time: ca.SX, state: ca.SX, values: ca.SX) -> list[ca.SX]:
        control = self._symbols[3]
        mode = control[control.numel() - len(self.loop.plant.contacts) :]
        return [time, *((ca.SX(0, 1), state) if self.period else (state, mode)), values]

    def _force(self, given: Sequence[ca.SX]) -> ca.SX:
        """What a force sensor feels: the multipliers."""
        names = list(self._compiled.outputs)
        sizes = [self.outputs[name].size() for name in names]
        first = sum(sizes[: names.index("constraint_force")])
        size = self.felt.stop - self.felt.start
        return self._compiled.row.call(list(given))[0][first : first + size]

    def _functions(
        self, value: ca.SX, valid: ca.SX
    ) -> tuple[VectorizedFunction, VectorizedFunction]:
        """A function, and one with its derivatives with respect to state and unknown parameters."""
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
        compiled, given = self._compiled, self._arguments()
        felt = self._symbols[1][self.felt]
        if not self.period:
            rate, valid = compiled.rate.call(given)
            if self.lag:
                rate = ca.vertcat(rate, (self._force(given) - felt) / self.lag)
            return self._functions(rate, valid)
        (update,) = compiled.rates
        noise = ca.SX.zeros(compiled.sizes["noise"])
        values, valid = update.function.call([*given, noise])
        state = ca.SX(self._symbols[1][: self.felt.start])
        state[list(update.places)] = values
        if self.lag:
            # The force of a step acts on the sensor during the next one.
            force = self._force(self._given(given[0] + self.period, state, given[-1]))
            share = float(np.exp(-self.period / self.lag))
            state = ca.vertcat(state, force + share * (felt - force))
        return self._functions(state, valid)

    @cached_property
    def _shows(self) -> tuple[VectorizedFunction, VectorizedFunction]:
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
        """A function at many moments, with derivatives along those of the state."""
        plain, full = functions
        given = time[:, None], moved.values, unknown, control, self.base
        if moved.slopes is None:
            return MovedPieces(plain(*given)[0])
        (count, n), (values, flat) = moved.values.shape, full(*given)
        local = flat.reshape(count, -1, n + unknown.size)
        with np.errstate(all="ignore"):  # The caller sees what is not finite.
            slopes = np.matmul(local[:, :, :n], moved.slopes)
        slopes[:, :, n:] += local[:, :, n:]
        return MovedPieces(values, slopes)

    def begun(self, states: FloatArray) -> MovedPieces:
        """The states at the beginning of pieces, shape (j, n), as values of themselves."""
        count, n = states.shape
        slopes = np.zeros((count, n, n + len(self.places)))
        slopes[:] = np.eye(n, n + len(self.places))
        return MovedPieces(states, slopes)

    def seen(
        self, time: FloatArray, moved: MovedPieces, unknown: FloatArray, control: FloatArray
    ) -> MovedPieces:
        """The outputs at times in s, shape (j,), below each other.

        Args:
            time: The times.
            moved: The states.
            unknown: The unknown parameters, shape (p,).
            control: The controls, and then which contacts are closed, shape (j, q).
        """
        return self._called(self._shows, time, moved, unknown, control)

    def step(
        self,
        time: FloatArray,
        after: FloatArray,
        moved: MovedPieces,
        unknown: FloatArray,
        controls: Sequence[FloatArray],
    ) -> MovedPieces:
        """The states at later times.

        Args:
            time, after: From when to when, in s, shape (j,).
            moved: The states at the former.
            unknown: The unknown parameters, shape (p,).
            controls: Of a continuous plant those at the beginning, in the middle and at the end of
                each of its equal steps; of a discrete plant that of each step. Each of shape
                (j, q).
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
            given = controls[2 * index : 2 * index + 3]
            moved = self._stages(time + index * h, h, moved, unknown, given)
        return moved

    def _stages(
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
    """What a step along the weighted sum of rates leads to."""
    values, slopes = moved
    for weight, rate in zip(weights, rates, strict=True):
        values = values + (weight * h)[:, None] * rate.values
        if slopes is not None and rate.slopes is not None:
            slopes = slopes + (weight * h)[:, None, None] * rate.slopes
    return MovedPieces(values, slopes)


def control_hold(plant: Plant, wires: Wires) -> System | None:
    """The block that holds the control of a plant between samples; None if there is none."""
    port = plant, int(plant.GetInputPort("control").get_index())
    while (source := wires.sources.get(port)) is not None:
        system, index = source
        if not system.HasDirectFeedthrough(index):
            return system if not system.num_continuous_states() else None
        if system.num_input_ports() != 1:
            return None
        port = system, 0
    return None
