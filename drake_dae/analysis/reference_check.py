"""Checks that each entry of a reference is the derivative of the one before."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae import DaeSystem, DerivativeLayout
from drake_dae.errors import ModelError


def check_reference(
    system: DaeSystem,
    layout: DerivativeLayout,
    reference: Callable[[float], FloatArray],
    times: ArrayLike,
) -> None:
    """Checks that each entry of a reference is the derivative of the entry before it."""
    grid = numbers(f"{system.name}: times", times).reshape(-1)

    def value(time: float) -> FloatArray:
        result = reference(time)
        values = None if result is None else numbers(f"{system.name}: reference({time:g})", result)
        if values is None or values.size != layout.reference_size:
            raise ModelError(
                f"{system.name}: the reference must have size {layout.reference_size} (each output "
                f"and its derivatives up to its degree {layout.degrees}), got "
                f"{'None' if values is None else values.size}"
            )
        return values.reshape(-1)

    if not grid.size or not np.all(np.isfinite(grid)):
        return
    value(float(grid[0]))
    length = float(grid[-1] - grid[0])
    step = 1e-6 * length
    if step <= 1e-9 * np.max(np.abs(grid)):
        return
    # Not at round fractions, where references have their breakpoints.
    tried = grid[0] + length * (0.05 + 0.9 * (np.arange(1, 10) * 0.6180339887 % 1.0))
    values = np.array([value(time) for time in tried])
    slopes, coarse = (
        np.array([(value(t + h) - value(t - h)) / (2 * h) for t in tried]) for h in (step, 2 * step)
    )
    signals = layout.reference_signals(system.output_signals)
    for i in map(int, layout.chained):
        stated, numeric = values[:, i + 1], slopes[:, i]
        scale = max(np.abs(stated).max(), np.abs(numeric).max())
        round_off = 1e-13 * np.abs(values[:, i]).max() / step
        unsure = 4.0 * np.abs(numeric - coarse[:, i])
        excess = np.abs(stated - numeric) - 1e-3 * scale - round_off - unsure
        worst = int(np.argmax(excess))
        if excess[worst] > 0.0:
            raise ModelError(
                f"{system.name}: the reference contradicts itself: its {signals[i + 1].name} = "
                f"{stated[worst]:.4g} at t = {tried[worst]:.4g} s, but {signals[i].name} "
                f"changes by {numeric[worst]:.4g} per second. Give the derivatives of r, output by "
                "output: r_1, r_1', ..., r_2, ..."
            )
