"""A closed loop as functions of time, state and parameters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.references import Reference
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.systems.plants.dae_plant import DaePlant
from drake_dae.systems.plants.robot_plant import RobotPlant
from drake_dae.trace.functions import TracedFunction

HOLD, LIMITS = "control_hold", "control_limits"
"""The names of what may stand between controller and plant."""


@dataclass(frozen=True, eq=False)
class LoopFunctions:
    """The functions of a closed loop, from which its derivative and its record are computed.

    Attributes:
        loop: The closed loop.
        is_model: Whether the plant is the law's own model, with the same numbers.
        signals: t -> R(t), and what moves with its derivatives, for the plant and for the law.
        plant: (x, u, parameters) -> x' and v.
        rest: (x, v, parameters) -> what else the record has of the plant, below each other.
        rest_signals: Name -> names and units of its entries.
    """

    loop: ClosedLoop
    is_model: bool
    signals: TracedFunction
    plant: TracedFunction
    rest: TracedFunction
    rest_signals: Mapping[str, Sequence[Signal]]

    @property
    def law(self) -> TracedFunction:
        """The law: (x, R, measured forces if it takes them, parameters) -> u, and the error."""
        return self.loop.controller.law.function

    def projection(self, count: int) -> ca.Function:
        """(x, the plant's parameters) -> x after Newton steps to N*, and how long the last was.

        Its length is that in states over their scale. Gradients of all are those at the start.

        Args:
            count: How many steps.
        """
        dae, newton = self.loop.plant.dae, self.loop.plant.structure.manifold.newton_step.function
        sizes = {"x": dae.num_states, "plant": self.plant.sizes[-1]}
        inputs = [ca.SX.sym(name, size) for name, size in sizes.items()]
        start, plant = inputs
        x, left = start, ca.SX(0.0)
        for _ in range(count):
            change = newton(x, start, plant)[0]
            x, left = x + ca.DM(dae.scale) * change, ca.norm_2(change)
        values = ca.cse([ca.densify(x), ca.densify(left)])
        return ca.Function("projection", inputs, values, {"cse": False})

    @property
    def rate(self) -> ca.Function:
        """Plant, law and sensor at once: what both compute of the state is computed once.

        A function of the state with that of the sensor and the law's integrals, of R, of what the
        sensor holds (or its noise), and of the parameters of plant and law. It returns the
        derivative, v, and a number that is finite if all have values and all matrices are regular.
        Of a plant that is the law's own model the derivative follows from what the law wants.
        """
        return self._motions[0]

    @property
    def row(self) -> ca.Function:
        """A row of the record, and a number that is finite if all has values.

        A function of what `rate` takes, and of the parameters of the plant that move.
        """
        return self._motions[1]

    @cached_property
    def _motions(self) -> tuple[ca.Function, ca.Function]:
        loop, dae = self.loop, self.loop.plant.dae
        lags, sensor, traced = self.num_lags, loop.sensor, loop.controller.law
        sizes = (
            self.size,
            self.law.sizes[1],
            dae.num_constraints,
            self.plant.sizes[-1],
            self.law.sizes[-1],
            self.signals.function.numel_out(1),
        )
        names = ("state", "reference", "hold", "plant", "law", "moving")
        inputs = [ca.SX.sym(name, size) for name, size in zip(names, sizes, strict=True)]
        state, reference, hold, plant, law, moving = inputs
        if self.is_model:
            plant, law = self._one_model(plant, law)
        places = np.cumsum([0, dae.num_states, lags, self.num_integrals]).tolist()
        x, felt, sigma = ca.vertsplit(state, places)
        measured, integral = [], [sigma] if self.num_integrals else []
        if self.is_direct and not traced.control_takes_force:
            measured = [ca.SX.zeros(dae.num_constraints)]
        elif self.is_direct:
            measured = [self.plant.function(x, ca.SX.zeros(dae.num_controls), plant)[1]]
        elif sensor is not None and sensor.sample_period:
            measured = [hold]
        elif sensor is not None:
            measured = [felt + sensor.bias + sensor.noise_deviation * hold]
        given = [x, reference, *measured, *integral, law]
        wanted, _, *of_law = self.law.function(*given)
        control, excess = wanted, ca.SX(0, 1)
        if self.limits is not None:
            control = ca.fmax(-self.limits, ca.fmin(self.limits, wanted))
            excess = wanted - control
        shown = measured[0] if sensor is not None else ca.SX(0, 1)

        def moved(by: TracedFunction, *arguments: ca.SX) -> list[ca.SX]:
            rate, force, *checks = by.function(*arguments)
            if lags and sensor is not None:
                rate = ca.vertcat(rate, (force - felt) / sensor.time_constant)
            if integral:
                read = [force] if self.is_direct else measured
                rates = self.law.function(x, reference, *read, *integral, law)[2]
                if self.limits is not None:  # Integrals stand still meanwhile.
                    rates = ca.if_else(ca.mmax(ca.fabs(wanted) - self.limits) > 0, 0, rates)
                rate = ca.vertcat(rate, rates)
            return [rate, force, checks[-1]]

        def function(name: str, given: Sequence[ca.SX], values: Sequence[ca.SX]) -> ca.Function:
            return ca.Function(name, given, ca.cse(values), {"cse": False})

        moves = moved(self.plant, x, control, plant)
        rate = function("rate", inputs[:-1], [*moves[:2], moves[2] + of_law[-1]])
        under = traced.trace_motion() if self.is_model and self.limits is None else None
        if under is not None:
            fewer = moved(under, *given)
            shorter = function("rate", inputs[:-1], fewer)
            if shorter.n_instructions() < 0.9 * rate.n_instructions():
                rate, moves = shorter, fewer
        rest, *checks = self.rest.function(x, moves[1], plant)
        row = ca.vertcat(x, rest, control, reference, moving, shown, sigma, excess)
        valid = moves[2] + of_law[-1] + checks[-1]
        return rate, function("row", inputs, [row, valid])

    def _one_model(self, plant: ca.SX, law: ca.SX) -> tuple[ca.SX, ca.SX]:
        """The parameters of plant and law, the same symbols where the numbers are the same."""
        law = ca.SX(law)
        places = list(self.loop.plant.exogenous_places)
        if places:
            law[places] = plant[places]
        return law[: plant.numel()], law

    @property
    def is_direct(self) -> bool:
        """Whether the law reads the constraint force without a sensor."""
        return bool(self.loop.controller.law.measured_force) and self.loop.sensor is None

    @cached_property
    def num_lags(self) -> int:
        """How many states the sensor has."""
        sensor = self.loop.sensor
        return self.loop.plant.dae.num_constraints if sensor and sensor.time_constant else 0

    @cached_property
    def limits(self) -> FloatArray | None:
        """The largest |u| that the drives give, shape (p,); None for drives without limits."""
        diagram = self.loop.diagram
        if not diagram.HasSubsystemNamed(LIMITS):
            return None
        found: FloatArray = diagram.GetSubsystemByName(LIMITS).limits
        return found

    @cached_property
    def num_integrals(self) -> int:
        """How many errors the law integrates."""
        return len(self.loop.controller.law.integral.outputs)

    @cached_property
    def size(self) -> int:
        """How many states there are: those of the plant, of the sensor, and of the law."""
        return self.loop.plant.dae.num_states + self.num_lags + self.num_integrals

    def integral(self, state: FloatArray) -> FloatArray:
        """The integrals of the law, shape (k,), in a state."""
        return state[self.size - self.num_integrals :]

    def felt(self, state: FloatArray) -> FloatArray:
        """The state of the sensor, shape (m,), in a state."""
        first = self.loop.plant.dae.num_states
        return state[first : first + self.num_lags]

    def plant_parameters(self, values: FloatArray) -> Callable[[float], FloatArray]:
        """The plant's parameters at a time in s, those that move as they are then.

        Args:
            values: The others.
        """
        if self.loop.exogenous is None:
            return lambda time: values

        def current(time: float) -> FloatArray:
            found = values.copy()
            moving = self.signals.evaluate(np.array([time]))[1]
            found[self.loop.plant.exogenous_places] = moving
            return found

        return current

    def measured(self, state: FloatArray, hold: FloatArray) -> FloatArray:
        """What the sensor measures, shape (m,).

        Args:
            state: x, then the state of the sensor if it has a lag, and the integrals.
            hold: What it holds if it samples, else its noise.
        """
        sensor = self.loop.sensor
        if sensor is None or sensor.sample_period:
            return hold
        return self.felt(state) + sensor.bias + sensor.noise_deviation * hold

    @property
    def num_operations(self) -> int:
        """How many operations all functions have together."""
        return sum(int(function.n_instructions()) for function in self.generated.values())

    @cached_property
    def generated(self) -> dict[str, ca.Function]:
        """Name -> function, of all that machine code is made of."""
        return {
            "signals": self.signals.function,
            "rate": self.rate,
            "row": self.row,
            "newton": self.projection(1),
        }

    @cached_property
    def columns(self) -> dict[str, Sequence[Signal]]:
        """The columns of a row of the record: name -> names and units."""
        loop, dae = self.loop, self.loop.plant.dae
        moving = loop.plant.exogenous_layout.reference_signals(dae.exogenous.signals)
        return {
            "state": dae.state_signals,
            **self.rest_signals,
            "control": dae.control_signals,
            "reference": loop.controller.law.reference_signals,
            "exogenous": moving if "exogenous" in loop.signals else (),
            "measured_force": dae.constraint_input_signals if loop.sensor else (),
            "integral": loop.controller.law.integral.signals,
            "excess": dae.control_signals if self.limits is not None else (),
        }


def loop_functions(loop: ClosedLoop) -> LoopFunctions:
    """The functions of a closed loop, where plant and law may have different numbers.

    Raises:
        ModelError: A reference is no expression of time, or the loop has what no rollout has:
            Drake's own contact, contacts that open and close, a sampled law, or exogenous signals
            of the plant alone.
    """
    plant, law = loop.plant, loop.controller.law
    unknown = "Drake's own contact, and no contacts that open"
    unknown = "" if isinstance(plant, DaePlant) else unknown
    unknown = unknown or ("a sampled law" if loop.diagram.HasSubsystemNamed(HOLD) else "")
    watched = loop.diagram.HasSubsystemNamed("tolerance_watch")
    unknown = unknown or ("tolerances" if watched else "")
    unknown = unknown or ("pushes that the law does not know" if loop.moves_otherwise else "")
    if unknown or not isinstance(plant, DaePlant):
        raise ModelError(f"a rollout does not know {unknown}; run the loop by simulate")
    dae, structure = plant.dae, plant.structure
    time = ca.SX.sym("t")
    moving = loop.exogenous.references if loop.exogenous is not None else ()
    signals = TracedFunction(
        "reference",
        {"time": time},
        {
            "R": _stacked(loop.reference.references, law.degrees, time),
            "plant": _stacked(moving, plant.exogenous_layout.degrees, time),
            "law": _stacked(moving, loop.controller.exogenous_layout.degrees, time),
        },
    )
    derivatives = structure.derivatives
    force = derivatives.expand(derivatives.constraint_input)
    acting = ca.SX.sym("v", dae.num_constraints)
    rest = {
        "constraint_force": dae.forces(acting),
        "constraint_residual": structure.manifold.residual_expression,
        "controlled_output": dae.l + ca.mtimes(dae.m, acting),
    }
    named = {
        "constraint_force": dae.force_signals,
        "constraint_residual": structure.manifold.residual_signals,
        "controlled_output": dae.output_signals,
    }
    if isinstance(plant, RobotPlant) and plant.model.loop_joints.signals:
        rest["loop_state"] = plant.model.loop_joints.state
        named["loop_state"] = plant.model.loop_joints.signals
    return LoopFunctions(
        loop,
        False,
        signals,
        dae.trace(
            "plant",
            {"rate": derivatives.expand(derivatives.rate), "force": force},
            {"control": derivatives.control},
            structure.elimination.pivot,
            "A(x) of Assumption (2)",
        ),
        dae.trace("signals", {"rest": ca.vertcat(*rest.values())}, {"force": acting}),
        named,
    )


def _stacked(references: Sequence[Reference], degrees: Sequence[int], time: ca.SX) -> ca.SX:
    rows, left = [ca.SX(0, 1)], list(degrees)
    for reference in references:
        own, left = left[: reference.size], left[reference.size :]
        row = reference.expression(own, time)
        if row is None:
            raise ModelError(
                f"a {type(reference).__name__} is no expression of time, and a rollout needs one: "
                "take an ExpressionReference, PointToPointReference or SinusoidReference, or run "
                "the loop by simulate"
            )
        rows.append(row)
    return ca.vertcat(*rows)
