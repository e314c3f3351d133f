"""Closed loops of extended systems against the original ones."""

import casadi as ca
import numpy as np
import pytest
from problems import integrated
from problems.extensions import wheels

from drake_dae.dae import Extension, TrackingLaw, dynamic_extension, poles


def original_loop(extension: Extension, law: TrackingLaw, start, reference, times) -> np.ndarray:
    """Outputs of the original system under the law as a dynamic state feedback.

    The original's states follow (1) with `original_control`; from the extended system come only
    the integrators. By SciPy's DOP853 with tolerances of 1e-11.
    """
    original, extended = extension.original, extension.system
    n = original.num_states
    fields = ca.Function("fields", [original.state], [original.f, original.h])
    output = ca.Function("output", [original.state], [original.l])
    rows = slice(n, None)
    integrators = ca.Function(
        "integrators", [extended.state], [extended.f[rows], extended.h[rows, :]]
    )

    def rate(t: float, state: np.ndarray) -> np.ndarray:
        w = law.control(state, reference(t))
        f, h = (np.array(e) for e in fields(state[:n]))
        moving = f[:, 0] + h @ extension.original_control(state, w)
        held, following = (np.array(e) for e in integrators(state))
        return np.concatenate([moving, held[:, 0] + following @ w])

    states = integrated(rate, start, times)
    return np.array([np.array(output(state[:n]))[:, 0] for state in states])


def wave(center: float, size: float, rate: float, degree: int, phase: float = 0.0):
    """center + size sin(rate t + phase) and its derivatives."""

    def at(t: float) -> list[float]:
        values = [
            size * rate**j * np.sin(rate * t + phase + j * np.pi / 2) for j in range(degree + 1)
        ]
        return [center + values[0], *values[1:]]

    return at


@pytest.mark.slow
def test_a_figure_of_eight():
    """x = 2 sin t, y = sin 2t from beside it: the error is the closed form, over both lobes."""
    extension = dynamic_extension(wheels(), nominal_control={"left": 10.0})
    law = TrackingLaw(extension.system, poles(-2.0), structure=extension.structure)
    across, along = wave(0.0, 2.0, 1.0, 2), wave(0.0, 1.0, 2.0, 2)

    def reference(t: float) -> np.ndarray:
        return np.concatenate([across(t), along(t)])

    start = np.array([0.2, -0.1, 0.6, 10.0])
    times = np.linspace(0.0, 2 * np.pi, 30)
    outputs = original_loop(extension, law, start, reference, times)
    wanted = np.array([reference(t)[[0, 3]] for t in times])
    predicted = law.predicted_error(times, start, reference(0.0))
    np.testing.assert_allclose(predicted[0], [0.2, -0.1], rtol=1e-15)
    # The integrator keeps 1e-11 a step of numbers of order 1.
    np.testing.assert_allclose(outputs - wanted, predicted, rtol=0, atol=1e-9)
