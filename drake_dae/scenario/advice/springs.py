"""The numbers of a cascade for springs that a scenario leaves out."""

from dataclasses import replace

import numpy as np

from drake_dae.dae.beyond.spring_loop import SpringLoop, spring_loop
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.scenario import Scenario

NOISE = 1e-3
"""The default standard deviation of velocity noise in rad/s, without encoders."""

_DIGITS = 3
"""The number of digits of recommended gains."""


def rounded(value: float) -> float:
    """Returns a recommended number, rounded to three digits for a scenario file."""
    return float(f"{value:.{_DIGITS}g}")


def velocity_noise(scenario: Scenario, period: float) -> float:
    """The standard deviation of measured velocities, in rad/s.

    Args:
        scenario: The scenario.
        period: The time between samples, in s.
    """
    if scenario.encoders is None:
        return NOISE
    return float(np.max(scenario.encoders.velocity_deviation(period))) or NOISE


def loop_note(scenario: Scenario) -> str:
    """The numbers of a cascade in words; empty without one."""
    loop = scenario.spring_loop
    return f"; a cascade with a loop of {loop.rate:g} rad/s around the springs" if loop else ""


def with_loop(scenario: Scenario) -> Scenario:
    """Computes the numbers of the loop around springs that a scenario leaves out."""
    law, sampling = scenario.law, scenario.sampling
    if not isinstance(law, parts.SpringCascadeForm):
        law = parts.SpringCascadeForm()
    if sampling is None:
        return replace(scenario, law=law.filled(SpringLoop(1.0)))  # law_robot refuses it.
    loop = spring_loop(sampling.period, sampling.late_samples, law.damping)
    rate, current_rate = rounded(loop.rate), rounded(loop.current_rate)
    return replace(scenario, law=law.filled(SpringLoop(rate, law.damping, rate, current_rate)))
