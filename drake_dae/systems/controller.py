"""The contract of a controller, and the tracking law as a LeafSystem."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import Block, Held, Requirement, where_finite
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import (
    ConstraintStructure,
    DaeSystem,
    DerivativeLayout,
    FeedbackGains,
    GainDesign,
    Signal,
    TrackingLaw,
    Verdict,
    ZeroDynamics,
)
from drake_dae.errors import ModelError, NonMinimumPhaseWarning, WiringError
from drake_dae.systems.plant import NOWHERE, ParameterizedSystem, Plant

if TYPE_CHECKING:
    from pydrake.systems.framework import System
else:
    System = object  # pybind11 has its own metaclass, as for plants.

Derived = dict[str, tuple[FloatArray, tuple[Signal, ...]]]
"""Name of a signal -> its values, one row for each time, and their names and units."""

Compared = tuple[FloatArray, FloatArray, Sequence[Signal]]
"""Outputs z and their desired values, shape (k,) each, and their names and units."""

SIGNAL = "signal_"  # the beginning of the name of an input port for a signal


@checked(ModelError)
@dataclass(frozen=True)
class PhaseChange:
    """The start of a phase of a task, with time, force, distance and its rate in SI units.

    `phase` is its name, or "done" or "held" where the robot rests, and `place` its index in the
    task. `in_contact` says whether the law for contact is active from then on, `reason` why the
    phase before ended, and `failed` whether it failed; of "held", whether the task was given up.
    """

    time: float
    phase: str
    place: int
    in_contact: bool
    reason: str
    force: float
    distance: float
    distance_rate: float
    failed: bool = False

    def __str__(self) -> str:
        return (
            f"{self.time:.6g} s: {self.phase}, {self.reason}; {self.force:.4g} N, "
            f"{self.distance:.4g} m, {self.distance_rate:.3g} m/s"
        )


@checked(ModelError)
class Controller(System):
    """The contract of a controller: a Drake System that computes the control of a plant.

    A controller is a LeafSystem or a Diagram with this class as its last base. The defaults here
    apply to everything that it does not override.

    1. Inputs. The input port `estimated_state` is x, shape (n,). Further input ports, if needed:
       `reference` (R of its `law`), `measured_force` (all constraint forces), `exogenous` (as of a
       `Plant`), `hold` (no integral of `law` is updated while it is not 0), and signal_<name> for
       each signal for which it waits. One that plans its references itself has the output port
       `contact_reference` for an observer, and `tared_force` where it corrects the measured force.
    2. Outputs. The output port `control` is u, shape (p,). `further_signals` are the other output
       ports in a record, with names and units; `shown` are those that a loop exports without
       recording them.
    3. Laws. `law` is the tracking law that acts in contact, of a system of the plant's sizes, and
       `all_parameters` are the parameters of its function. `set_gains` changes its gains in a
       context; a controller with fixed gains refuses.
    4. Plants. `check_plant` refuses a plant that does not fit.
    5. Computed afterwards. `derived` are further signals of a record, computed from the others.
       `compared` are outputs and their references now, for the check of divergence. With `follows`
       its control is that of `law` alone.
    6. Theory. `predicted_error` is the predicted tracking error of a record.
    7. Starts. With `takes_over` its references start at the current outputs; otherwise they come
       from a generator, and a run starts at their start. A run starts on the manifold of
       `start_structure`.
    8. Phases. `changes` are the starts of the phases of a run, with reasons, from its record, and
       `phase_names` the names of the phases and of the rest after them; both are empty without
       phases.
    """

    __slots__ = ()

    law: TrackingLaw
    shown: tuple[str, ...] = ()
    phase_names: tuple[str, ...] = ()
    follows: bool = False
    takes_over: bool = False
    exogenous_layout: DerivativeLayout = DerivativeLayout(())
    exogenous_places: list[int] = NOWHERE

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        """Name of a further output port in a record -> names and units of its entries."""
        return {}

    @property
    def start_structure(self) -> ConstraintStructure:
        """The structure on whose manifold a run starts."""
        return self.law.structure

    def all_parameters(self, context: Context) -> FloatArray:
        """The parameters of the law's function: the model's at the context's time, and K."""
        return self.law.all_parameters()

    def current_parameters(self, context: Context) -> FloatArray:
        """The parameters of the law's model at the context's time, shape (k,)."""
        return self.law.system.parameter_values

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        """Changes the gains of the law in a context, or refuses to."""
        raise ModelError(f"the gains of a {type(self).__name__} are fixed when it is made")

    def check_plant(self, plant: Plant) -> None:
        """Refuses a plant that does not fit, by a WiringError."""
        check_law(plant.dae, self.law)

    def derived(self, values: Mapping[str, FloatArray]) -> Derived:
        """Desired outputs, errors and others from the other signals of a record."""
        return {}

    def compared(self, context: Context, shown: Callable[[str], FloatArray]) -> Compared | None:
        """The outputs now and their desired values; `shown` has the value of a plant's signal."""
        port = self.GetInputPort("reference") if self.HasInputPort("reference") else None
        if port is None or not port.HasValue(context):
            return None
        desired = port.Eval(context)[self.law.layout.lowest]
        return shown("controlled_output"), desired, self.law.system.output_signals

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """The predicted tracking error, one row for each time of a record with these values."""
        raise NotImplementedError

    def changes(self, values: Mapping[str, FloatArray]) -> tuple[PhaseChange, ...]:
        """The start of each phase of a run, with the reason, from the signals of its record."""
        return ()


def check_law(dae: DaeSystem, law: TrackingLaw) -> None:
    """Refuses a law for a system of another size than the plant's, by a WiringError."""
    has, takes = (
        f"{s.num_states} states, {s.num_controls} controls and {s.num_constraints} constraints"
        for s in (dae, law.system)
    )
    if has != takes:
        raise WiringError(
            f"the law is for '{law.system.name}' with {takes}, the plant '{dae.name}' has {has}. "
            "Make the law for the plant's system, TrackingLaw(plant.dae, ...), or for one like it"
        )


@checked(ModelError)
class TrackingController(ParameterizedSystem, Controller):
    """The law (28) of any `TrackingLaw`: u = B(x)^-1 (-a(x) + ubar(x, R)).

    Input ports:
        estimated_state: x, shape (n,).
        reference: R, output-major, r_i, ..., r_i^(mu_i); shape (sum (mu_i + 1),).
        measured_force: The constraint force from a sensor, shape (m,); if the law takes it.
        exogenous: The signals w with their derivatives, if there are any.
        hold: Of a law with integrals, shape (1,): no error is integrated while it is not 0, as
            while a drive is at its limit or a contact is lost; 0 without a wire.

    Output ports:
        control: u, shape (p,).
        tracking_error: e = z - r (29) by the controller's own model, one entry per output.
        integral: The integrals of errors, shape (k,), if the law has any: its only state, which
            starts at zero.

    The first two output ports have direct feedthrough from all input ports except `hold`, and
    except `measured_force` if the law only integrates it. Numeric parameter 0 holds the model's
    parameters and then the gains. The block converts to AutoDiffXd.

    Args:
        law: The law.
        outputs: z at which its zero dynamics are judged, shape (p,); see `ZeroDynamics.stability`.
        sample_period: That of integrals in s, as for discrete plants; 0 for continuous ones.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics (35) are unstable about that equilibrium.

    Raises:
        ModelError: The period is not valid.
        SingularityError, NonFiniteError: A(x) or B(x) is singular, or a value is not finite, on the
            way; the exception has time and state.
    """

    __slots__ = SHARED_DICTIONARY
    follows, is_law, shown = True, True, ("tracking_error",)

    def __init__(
        self, law: TrackingLaw, outputs: ArrayLike | None = None, *, sample_period: float = 0.0
    ) -> None:
        count = len(law.integral.outputs)
        if count and not sample_period >= 0.0:
            raise ModelError(f"sample_period must be 0 s or more, got {sample_period:g} s")
        if law.structure.zero_dynamics_dimension:
            dynamics = ZeroDynamics(law.system, structure=law.structure)  # (35)
            stability = dynamics.stability(law.structure.states[0], outputs=outputs)
            if stability.verdict is Verdict.UNSTABLE:
                warnings.warn(
                    f"{law.system.name}: {stability.reason}. The outputs follow the reference "
                    "while other states, or the control, grow without bound; choose other outputs",
                    NonMinimumPhaseWarning,
                    stacklevel=2,
                )
        self.law, self.sample_period = law, sample_period if count else 0.0
        block = law_block(law, self.sample_period)
        self.equations = law.system
        super().__init__(law.system, block, law.exogenous_degrees, sees_steps=True)

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        """Changes the gains in a context: a design such as `poles(-8.0)`, or finished gains.

        Raises:
            GainError: They do not fit, are not Hurwitz, or couple outputs that the law does not.
        """
        values = self.law.all_parameters(self.parameters(context), gains)
        context.get_mutable_numeric_parameter(0).SetFromVector(values)

    def all_parameters(self, context: Context) -> FloatArray:
        self.check_context(context)
        return np.array(self._values(context))

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        integral = self.law.integral
        return {"integral": integral.signals} if integral.outputs else {}

    def derived(self, values: Mapping[str, FloatArray]) -> Derived:
        """`desired_output` r and `tracking_error` z - r (29), from "reference" and z."""
        law = self.law
        desired, signals = values["reference"][..., law.layout.lowest], law.system.output_signals
        error = values["controlled_output"] - desired
        return {"desired_output": (desired, signals), "tracking_error": (error, signals)}

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        integral = values["integral"][0] if self.law.integral.outputs else None
        start = values["state"][0], values["reference"][0]
        return self.law.predicted_error(times - times[0], *start, parameters, integral)

    def motion(self) -> ca.SX | None:
        motion = self.law.trace_motion()
        if motion is None:
            return None
        rate, *_, valid = motion.function.call([*self.law.inputs.values()])
        return where_finite(rate, valid)


def law_block(law: TrackingLaw, sample_period: float) -> Block:
    """The law (28) with the integrals of its errors, as a block; see `TrackingController`."""
    system, signals = law.system, law.integral.signals
    named = {"state": "estimated_state"}
    inputs = {named.get(name, name): symbol for name, symbol in law.inputs.items()}
    parameters = inputs.pop("parameters")
    regular = Requirement.regular(law.pivot, law.regular)
    values = {name: regular.of(value) for name, value in law.outputs.items()}
    shown = {name: values[name] for name in ("control", "tracking_error")}
    block = Block(
        "tracking_controller",
        inputs,
        shown,
        parameters=parameters,
        start={"parameters": law.all_parameters()},
        requirements=(regular,),
        signals={
            "estimated_state": system.state_signals,
            "reference": law.reference_signals,
            "measured_force": system.constraint_input_signals,
            "control": system.control_signals,
            "tracking_error": system.output_signals,
            "integral": signals,
            "parameters": law.parameter_signals,
        },
    )
    if not signals:
        return block
    sigma, hold = inputs.pop("integral"), ca.SX.sym("hold")
    rate = ca.if_else(hold != 0, 0, values["integral_rate"])
    block = replace(
        block,
        inputs={**inputs, "hold": hold},
        outputs={**shown, "integral": sigma},
        defaults={"hold": ca.SX.zeros(1)},
    )
    if not sample_period:
        return replace(block, state=sigma, derivative=rate)
    start = np.zeros(len(signals))
    summed = Held(sigma, sigma + sample_period * rate, start, sample_period)
    return replace(block, held={"integral": summed})
