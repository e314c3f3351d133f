"""The touch of a task on a compliant contact: its largest force, and the speed that keeps it."""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, pi

import numpy as np
from scipy.linalg import expm

from drake_dae.arrays import FloatArray
from drake_dae.references import Reference
from drake_dae.scenario.parts.task import ScenarioTask
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.task.fade import fade
from drake_dae.systems.task.phases import Approach, Press

_PERIODS = 3
"""The number of oscillations of the contact after the force has reached its goal."""


def touch_peak(felt: float, speed: float, stiffness: float, mobility: float, late: float) -> float:
    """The largest expected force in N when contact is made, F + v (sqrt(k / A) + k t).

    The contact of stiffness k stops the effective mass 1 / A of the tool from the speed v, and in
    the time t until the law reacts the tool moves on by v t.

    Args:
        felt: F, the force that ends the phase, in N.
        speed: v, in m/s.
        stiffness: k, in N/m.
        mobility: A, in 1/kg.
        late: t, in s.
    """
    return felt + speed * ((stiffness / mobility) ** 0.5 + stiffness * late)


def reaction_time(sampling: Sampling | None, step: float) -> float:
    """The longest time in s until a law reacts.

    Args:
        sampling: The sampling of the law; None where it acts at each step of the plant.
        step: The step of the plant, in s.
    """
    if sampling is None:
        return step
    return sampling.period * (1 + sampling.late_samples)


def rounded(value: float) -> float:
    """Returns a recommended number, rounded to three digits for a scenario file."""
    return float(f"{value:.3g}")


@dataclass(frozen=True)
class Touching:
    """A compliant contact at the moment of a touch, and the law that acts on it.

    Attributes:
        stiffness: k, in N/m.
        mobility: A = J M^-1 J^T along the normal, in 1/kg.
        damping: c, the damping of the constraint by the law, in 1/s.
        force_gain: K_i, the gain of the integral of the force's error, in 1/s.
        period: T, the sample time, in s.
        late: The longest time until the law reacts, in s.
    """

    stiffness: float
    mobility: float
    damping: float
    force_gain: float
    period: float
    late: float

    def lasting_speed(self, felt: float, goal: float, over: float) -> float:
        """The largest speed of a touch, in m/s, after which the force does not fall to zero again.

        The law holds for each sample the force

            u = lambda + K_i sum (lambda - F) T - c d' / A,    d'' = A (u - F),    F = k d,

        with the depth d and the reference lambda, a `fade` from the felt force to the goal. F is
        linear in the speed v of the touch, F = F_lambda(t) + v F_v(t), so that the largest v is the
        least F_lambda / -F_v of all times with F_v < 0.

        Args:
            felt: The force at the touch, in N.
            goal: The force to which the law presses, in N.
            over: The duration of this, in s.
        """
        oscillation = 2.0 * pi / (self.stiffness * self.mobility) ** 0.5
        times = np.arange(0.0, over + _PERIODS * oscillation, self.period)
        powers = np.minimum(times / over, 1.0)[:, None] ** np.arange(6)
        reference = goal + powers @ np.array(fade([felt - goal], [0], over)[0])
        of_reference = self._force(felt / self.stiffness, 0.0, reference)
        of_speed = self._force(0.0, 1.0, 0.0 * reference)
        opens = of_speed < 0.0
        return float(np.min(of_reference[opens] / -of_speed[opens], initial=inf))

    def _force(self, depth: float, rate: float, reference: FloatArray) -> FloatArray:
        """F at each sample after a touch."""
        k, A, period = self.stiffness, self.mobility, self.period
        step = expm(period * np.array([[0.0, 1.0, 0.0], [-A * k, 0.0, A], [0.0, 0.0, 0.0]]))
        waiting = [k * depth] * (round(self.late / period) - 1)
        integral, forces = 0.0, np.empty(reference.size)
        for index, wanted in enumerate(reference.tolist()):
            forces[index] = force = k * depth
            waiting.append(wanted + self.force_gain * integral - self.damping * rate / A)
            integral += period * (wanted - force)
            depth, rate, _ = step @ [depth, rate, waiting.pop(0)]
        return forces

    def slowed(self, task: ScenarioTask) -> ScenarioTask:
        """The task with a `lasting_speed` for each Approach without a speed, or its default."""
        phases = list(task.phases)
        for index, (phase, then) in enumerate(pairwise(phases)):
            if isinstance(phase, Approach) and phase.speed is None and isinstance(then, Press):
                lasting = self._lasting(task, then)
                phases[index] = replace(phase, speed=rounded(min(phase.speed_of_approach, lasting)))
        return replace(task, phases=phases)

    def _lasting(self, task: ScenarioTask, press: Press) -> float:
        if isinstance(press.force, Reference):
            return inf
        return self.lasting_speed(task.contact_force, press.force, press.over)

    def note(self, task: ScenarioTask) -> str:
        """A sentence on the largest `touch_peak` of a task, and on touches that may not last."""
        peaks, lost = [], ""
        made = task.make().phases
        for phase, then in zip(made, [*made[1:], None], strict=True):
            if isinstance(phase, Approach):
                felt, speed = phase.felt(task.contact_force), phase.speed_of_approach
                peak = touch_peak(felt, speed, self.stiffness, self.mobility, self.late)
                peaks.append((peak, speed, phase.name))
                if isinstance(then, Press) and speed > (most := rounded(self._lasting(task, then))):
                    lost = (
                        f". After {phase.name} at {speed:g} m/s the tool may bounce: {then.name} "
                        f"keeps the contact up to {most:.2g} m/s; a shorter `over` of {then.name} "
                        "allows more"
                    )
        if not peaks:
            return ""
        peak, speed, name = max(peaks)
        which = f" by {name}" if len(peaks) > 1 else ""
        return f". A touch{which} at {speed:g} m/s is expected to stay below {peak:.3g} N{lost}"
