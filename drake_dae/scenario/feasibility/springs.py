"""The laws for springs in the joints that are possible with given noise and sample time."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.beyond.spring_bound import stable_scales
from drake_dae.dae.beyond.spring_loop import SpringLoop, contact_gains_behind, spring_loop
from drake_dae.dae.structure.structure import Structure
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice.springs import velocity_noise
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.cascade.torque_loop import stages_of

ROUGH = 0.05
"""The allowed change of a control from sample to sample by noise, in effort limits."""

_SLOWEST_POLES = 30.0
"""The slowest poles of a tracking law behind springs that is useful, in 1/s."""

_STIFFNESS_MARGIN = 2.0
"""The factor by which springs may be stiffer or softer than in the model of an acceptable loop."""


@dataclass(frozen=True, eq=False)
class SpringLaws:
    """The requirements of two laws for springs in the joints.

    Attributes:
        noise: The standard deviation of velocities, rad/s.
        late: The mean time until a control acts, s.
        swing: The fastest oscillation of links against shafts, rad/s.
        pole: The least distance of four equal poles of the tracking law from 0, 1/s.
        rough: Its change of controls from sample to sample by noise, the largest in effort limits.
        loop: The loop of the cascade.
        scales: The range of stiffnesses for which the loop is stable, relative to the given ones;
            None if it is unstable for these.
        cascade_rough: As `rough`, of the cascade.
    """

    noise: float
    late: float
    swing: float
    pole: float
    rough: float
    loop: SpringLoop
    scales: tuple[float, float] | None
    cascade_rough: float

    @property
    def bears_tracking(self) -> bool:
        """Whether the tracking law is not too rough."""
        return self.rough <= ROUGH

    @property
    def bears_cascade(self) -> bool:
        """Whether the cascade is stable with a margin, and not too rough."""
        low, high = self.scales or (np.inf, 0.0)
        is_robust = low <= 1.0 / _STIFFNESS_MARGIN and high >= _STIFFNESS_MARGIN
        return is_robust and self.cascade_rough <= ROUGH

    def to_dict(self) -> dict[str, Any]:
        """The requirements as plain numbers and lists."""
        return {
            **asdict(self),
            "scales": None if self.scales is None else list(self.scales),
            "bears_tracking": self.bears_tracking,
            "bears_cascade": self.bears_cascade,
        }

    @property
    def lines(self) -> list[str]:
        """The requirements in words."""
        scales = "unstable for these springs"
        if self.scales is not None:
            low, high = self.scales
            scales = f"stable for springs {low:g} to {high:g} times as stiff"
        verdict = {
            (True, True): "both laws: !Tracking if the model is exact and friction known and "
            "without reversals, else !SpringCascade",
            (False, True): "!SpringCascade alone",
            (True, False): "!Tracking alone",
            (False, False): "neither law: sample more often, lower the noise, or model the springs "
            "that are too stiff as rigid joints",
        }[self.bears_tracking, self.bears_cascade]
        return [
            f"springs: links and shafts swing against each other with up to {self.swing:.3g} "
            f"rad/s; controls act {1e3 * self.late:.3g} ms late, velocities have noise of "
            f"{self.noise:.2g} rad/s",
            f"!Tracking      four equal poles at -{self.pole:.3g} 1/s or faster; controls change "
            f"by {100 * self.rough:.2g} % of a limit from sample to sample, by noise",
            f"!SpringCascade a loop of {self.loop.rate:.3g} rad/s, {scales}; controls change by "
            f"{100 * self.cascade_rough:.2g} %",
            f"Noise and sample time bear {verdict} (allowed: {100 * ROUGH:g} %, and a factor of "
            f"{_STIFFNESS_MARGIN:g} of the springs)",
        ]


def spring_laws(
    scenario: Scenario, model: RobotModel, links: RobotModel, structure: Structure
) -> SpringLaws | None:
    """The requirements of the laws for a scenario with springs and sampling; None for any other.

    Near the start, with the mass M of the links, the stiffness K and the inertia B of the shafts, a
    joint oscillates at W^2 = K (1 / M + 1 / B). Four equal poles of the tracking law at -p are
    stable if 20 p > W^2 t, see `FlexibleJoints`. Its velocity gains are B K^-1 M 4 p^3 for links
    and 4 p B for spring rates, with p = 30 1/s or more. The velocity gains of the cascade are
    2 zeta w B for shafts and, for links, those of the recommended rigid law and observer, M (2 p +
    k_o), times B K^-1 w^2 (1 + 4 zeta).

    Args:
        scenario: The scenario.
        model: Its robot.
        links: Its links by themselves.
        structure: The structure of their system.
    """
    sampling = scenario.sampling
    if sampling is None or len(model.stages) > 1:
        return None
    spring, _ = stages_of(model)
    p = model.dae.num_controls
    numbers = model.dae.trace("springs", {"K": spring.stiffness, "B": spring.inertia}, often=False)
    dae, values = model.dae, model.dae.parameter_values
    K, B = (np.array(entries).reshape(p, p) for entries in numbers(dae.nominal_state, values))
    mass, mobilities = _mobilities(links, structure)
    noise = velocity_noise(scenario, sampling.period)
    late = sampling.mean_delay + sampling.period / 2.0
    swing = float(np.sqrt(np.max(np.linalg.eigvals((np.linalg.inv(B) + mobilities[0]) @ K).real)))
    pole = swing**2 * late / 20.0
    used = max(pole, _SLOWEST_POLES)
    loop = scenario.spring_loop or spring_loop(sampling.period, sampling.late_samples)
    w, zeta = loop.rate, loop.damping
    shaped = B @ np.linalg.inv(K)
    limits = np.where(np.isfinite(links.control_limits), links.control_limits, np.inf)

    def rough(*gains: FloatArray) -> float:
        """The largest change by independent noise of several velocities, in effort limits."""
        squares = sum(np.square(gain).sum(axis=1) for gain in gains)
        return float(np.max(np.sqrt(2.0 * squares) * noise / limits))

    advice = contact_gains_behind(loop, 1.0, 1.0, sampling.period, sampling.late_samples, noise)
    outer = mass * (2.0 * advice.position_rate + advice.observer_rate)
    return SpringLaws(
        noise,
        late,
        swing,
        pole,
        rough(shaped @ mass * 4.0 * used**3, 4.0 * used * B),
        loop,
        stable_scales(K, B, mobilities, loop, sampling.period, sampling.late_samples),
        rough(2.0 * zeta * w * B, shaped @ outer * w**2 * (1.0 + 4.0 * zeta)),
    )


def _mobilities(links: RobotModel, structure: Structure) -> tuple[FloatArray, list[FloatArray]]:
    """M of the actuated joints, and the mobilities of free and of constrained links."""
    system, B = links.dae, links.links.actuation_matrix
    first = links.links.q.numel()
    function = system.trace(
        "mobility",
        {"M": system.mass_matrix[first:, first:], "held": structure.elimination.h_star[first:, :]},
        often=False,
    )
    nv = B.shape[0]
    mass, h_star = function(structure.states[0], system.parameter_values)
    free = B.T @ np.linalg.inv(np.array(mass).reshape(nv, nv)) @ B
    constrained = B.T @ np.array(h_star).reshape(nv, B.shape[1])
    return np.asarray(np.linalg.inv(free)), [np.asarray(free), constrained]
