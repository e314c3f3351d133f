"""An observer of model errors: a disturbance, and coefficients of friction."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_dae.arguments import checked
from drake_dae.blocks.block import Held, where_finite
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import Signal, TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.observing.observer_functions import ObserverFunctions
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.observing.observing_system import (
    ObservingSystem,
    check_timing,
    columns,
    observer_block,
)


@checked(ModelError)
class DisturbanceObserver(ObservingSystem):
    """Observes the disturbance d of E x' = f + S d + g v + h u, and identifies friction.

    With the momentum p = S^T E x a sample of d is, for samples T apart,

        d_k = (p_k - p_(k-1)) / T - mean((S^T E)' x + S^T f) - S^T (h u + g v),

    whose low-pass r with the rate k_o is the estimate; its part along the constrained directions
    has the rate k_n. A constant d is reached as 1 - e^(-k_o t); velocity noise n leaves noise of
    about k_o M n in r. With flexible joints or motors the law needs derivatives of r: then r is
    the output of several lags in series, see `Lags`. With c = S^T dg/dmu v, friction takes its
    share of r,

        mu' = k_f (c . r) / (c . c),    r' = k_o (d - r) - c mu',

    so that r + c mu follows d with the rate k_o for any k_f, without a jump when the share moves.

    Input ports:
        estimated_state: x, shape (n,).
        control: The applied u, shape (p,).
        measured_force: v, shape (m,).
        hold: Not 0 while a drive is at its limit, shape (1,); 0 without a wire. Then mu is not
            updated; r is, since it depends on the applied u.
        reference: R of the controller; without a wire the current outputs and rates.

    Output ports:
        exogenous: The disturbance to compensate, and mu, each with the derivatives that the law
            needs, for the port of a `TrackingController` with the same law.
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        hold: 1 while the input `hold` is not 0 or a frictional contact is lost, else 0, shape (1,):
            for the integrals of the controller.
        identified, identified_deviation: All estimated parameters with friction, and their standard
            deviations, shape (c,) each; only with such parameters.

    If the law's system has other parameters that `with_disturbance` made exogenous, all of them and
    friction are estimated together, by a Kalman filter of r; see `ParameterFilter`.

    `disturbance` and `friction` are held between samples; r starts at 0, and mu at the model's
    coefficients.

    Args:
        law: The law, for a system that `with_disturbance` made.
        observing: The rates, and the thresholds for friction.
        sample_period: T in s.
        control_lag: The fraction of T for which the plant uses the previous control, from 0 to 1: 1
            for a discrete plant of that step, 0 for a `ControlHold` without delay before a
            continuous plant.
        control_delay: tau in s, the mean time from a sample until its control acts: the delay, and
            half of T, for which it is held.
        is_ideal: Whether the contacts of the plant are ideal, with the friction of the model. On a
            contact that gives way friction is fully developed at a tenth of the speed.

    Attributes:
        observation: The observed functions.
        observing, sample_period: The arguments.
        disturbance_signals, friction_signals, identified_signals: Names and units of the output
            ports.

    Raises:
        ModelError: The law's system has no disturbance, or a number is not valid.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        sample_period: float,
        control_lag: float = 0.0,
        control_delay: float = 0.0,
        is_ideal: bool = False,
    ) -> None:
        period = check_timing(sample_period, control_lag, control_delay)
        functions = ObserverFunctions(law, observing, period, control_lag, control_delay, is_ideal)
        memory, filtered = functions.memory, functions.filter
        column, p = memory.column, law.system.parameter_symbol
        inputs = columns(law, "estimated_state", with_force=True)
        x, u, hold, reference, force = inputs.values()
        after, _, *checks = functions.sample.function(x, column, u, force, hold, reference, p)
        signals, *valid = functions.exogenous.function(x, column, force, reference, p)
        start = np.zeros(column.numel())
        start[start.size - filtered.start.size :] = filtered.start
        outputs = {
            "exogenous": where_finite(signals, valid[-1]),
            "disturbance": memory.disturbance,
            "friction": memory.friction,
        }
        place = memory.disturbance.numel()
        held = Held(column, where_finite(after, checks[-1]), start, period)
        block = observer_block(
            "disturbance_observer", law, functions, inputs, outputs, force, held, place
        )
        identified = functions.observation.identified.signals
        if identified:
            names = (*identified, *block.signals["friction"])
            estimates = {
                "identified": filtered.values(memory.friction),
                "identified_deviation": filtered.deviations,
            }
            block = replace(
                block,
                outputs={**block.outputs, **estimates},
                signals={**block.signals, **dict.fromkeys(estimates, names)},
            )
        super().__init__(law, observing, period, functions, block, place)

    @property
    def identified_signals(self) -> Sequence[Signal]:
        """Names and units of `identified`; empty without it."""
        return self.block.signals.get("identified", ())
