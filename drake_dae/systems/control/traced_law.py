"""The computations of the block of a tracking law, as traced functions.                 (28)"""

from collections.abc import Mapping, Sequence
from functools import partial

import casadi as ca
import numpy as np
from pydrake.systems.framework import System

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import (
    DERIVATIVE,
    HELD,
    PARAMETERS,
    STATE,
    Block,
    Computation,
    Update,
    zero,
)
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw


def traced_law(
    block: System,
    law: TrackingLaw,
    limits: FloatArray,
    sample_period: float,
    moving: Sequence[int],
    signals: Mapping[str, Sequence[Signal]],
) -> Block:
    """The computations of a `TrackingController`, and its updates of integrals at samples.

    Args:
        block: The controller.
        law: Its law.
        limits: The largest |integral| of each error, shape (k,).
        sample_period: The sample period of integrals, in s; 0 for continuous integrals.
        moving: The indices of parameters that come through its port "exogenous".
        signals: Names and units of the inputs of its functions, for messages.
    """
    memory = HELD if law.integral.outputs and sample_period else STATE
    named = {"state": "estimated_state", "integral": memory, "parameters": PARAMETERS}
    sources = tuple(named.get(name, name) for name in law.function.input_names)
    shown = ("control", "tracking_error")
    computations: tuple[Computation, ...]
    updates: tuple[Update, ...] = ()
    unwired = {}
    if not law.integral.outputs:
        computations = (Computation.of(law.function, sources, shown),)
    else:
        computations, updates = _traced_integrals(
            law, limits, sample_period, sources, shown, memory
        )
        unwired["hold"] = zero("hold", limits.size)
    return Block(
        block,
        computations,
        updates,
        unwired=unwired,
        moving=tuple(moving),
        model=law.system,
        under=partial(_motion_under, law, sources),
        signals=signals,
        ports={
            "control": tuple(law.system.control_signals),
            "tracking_error": tuple(law.system.output_signals),
            "integral": tuple(law.integral.signals),
        },
    )


def _traced_integrals(
    law: TrackingLaw,
    limits: FloatArray,
    sample_period: float,
    sources: tuple[str, ...],
    shown: tuple[str, ...],
    memory: str,
) -> tuple[tuple[Computation, ...], tuple[Update, ...]]:
    """The computations of a law with integrals, and their updates at samples."""
    function = law.function
    acts = Computation.of(function, sources, shown)
    if law.measured_force and not law.control_takes_force:
        # Independent of the force, so that there is no direct feedthrough from it.
        place = sources.index("measured_force")
        inputs = [
            ca.SX.sym(name, size)
            for name, size in zip(function.input_names, function.sizes, strict=True)
        ]
        without_force = [*inputs]
        without_force[place] = ca.SX.zeros(function.sizes[place])
        without = ca.Function(
            "control",
            [*inputs[:place], *inputs[place + 1 :]],
            function.function.call(without_force),
        )
        acts = Computation(without, (*sources[:place], *sources[place + 1 :]), shown, function)
    rates = Computation.of(function, sources, ("", "", "integral_rate"))
    count = limits.size
    rate, sigma, hold = (ca.SX.sym(name, count) for name in ("rate", "integral", "hold"))
    moves = rate
    limited = np.flatnonzero(np.isfinite(limits)).tolist()
    if limited:
        leaves = (ca.fabs(sigma) >= limits) * (rate * sigma > 0)
        moves = ca.SX(moves)
        moves[limited] = ca.if_else(leaves, 0, rate)[limited]
    moves = ca.if_else(hold != 0, 0, moves)
    after = sigma + sample_period * moves if sample_period else moves
    inputs, of = [rate, sigma, hold], ("integral_rate", memory, "hold")
    output = HELD if sample_period else DERIVATIVE
    summed = Computation(ca.Function("integral", inputs, [after]), of, (output,))
    accumulated = Computation(ca.Function("integral", [sigma], [sigma]), (memory,), ("integral",))
    if sample_period:
        return (acts, rates, accumulated), (Update(summed, sample_period, 0.0, True),)
    return (acts, rates, accumulated, summed), ()


def _motion_under(law: TrackingLaw, sources: tuple[str, ...]) -> Computation | None:
    """x' and v of a plant that is the law's own model, from the desired derivatives."""
    motion = law.trace_motion()
    if motion is None:
        return None
    return Computation.of(motion, sources, (DERIVATIVE, "constraint_input"))
