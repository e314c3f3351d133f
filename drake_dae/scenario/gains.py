"""The gains that a scenario with compliant contact leaves out, and what belongs to them."""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, pi

import casadi as ca
import numpy as np
from scipy.linalg import expm

from drake_dae.analysis.gains import DAMPING, DECAY, FORCE, ContactGains, contact_gains
from drake_dae.analysis.sampled_loop import EVERY
from drake_dae.arrays import FloatArray
from drake_dae.dae import Structure
from drake_dae.dae.law_model import damping_gains
from drake_dae.dae.law_terms import Deflection
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.references import Reference, SinusoidReference
from drake_dae.robots import RobotModel
from drake_dae.scenario import parts as parts
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.form import at
from drake_dae.scenario.model import reference_and_start, references_of
from drake_dae.scenario.parts import ScenarioTask
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import opening_contact
from drake_dae.systems.plants.contact.contact_material import PointMaterial
from drake_dae.systems.task.automaton import SMOOTH, fading
from drake_dae.systems.task.phases import Approach, Press

_SOFTER = 5.0
"""The ratio of the poles of positions to those of the distance, of a robot without contact."""

_FORCE = 10.0
"""The force in N at which the stiffness of a hydroelastic patch is evaluated."""

_PERIODS = 3
"""The number of oscillations of the contact after the force of a touch has reached its goal."""

_LONGEST = 10.0
"""The longest motion in s along which the loop is examined."""

_ROUND, _FAST = 0.02, 2.5
"""The circle in m, and its frequency in rad/s, for which the gains of a task are computed."""


def advised(scenario: Scenario, model: RobotModel, structure: Structure) -> Completed:
    """Computes gains and other settings that a scenario in contact that gives way leaves out.

    It computes the gains of `contact_gains`, integrals of forces and of points, constraint damping,
    an estimator of disturbance and friction, measured force, and the law's contact stiffness where
    references of forces are smooth, each if it is left out; and for a task the gains without
    contact, soft along the distance. A scenario with `law.gains`, or with ideal contact, is
    unchanged.

    Args:
        scenario: The scenario, with all of its outputs.
        model: Its robot.
        structure: The structure of the model's system.

    Returns:
        The scenario, and the choices in words.

    Raises:
        ScenarioError: There are no default gains for such a scenario, or none are smooth and
            stable; or `largest_roughness` is given and not used.
    """
    material = scenario.plant.material
    law, sensors = scenario.law, scenario.sensors
    if law.largest_roughness is not None and not scenario.is_advised:
        text = "it is used only for computed gains; leave it out, or leave `law.gains` out"
        raise ScenarioError(("law.largest_roughness", text))
    if material is None or not scenario.is_advised:
        return Completed(scenario)
    if model.stages:
        text = (
            "no gains are computed if the robot has springs, motors or valves. Give gains, "
            "integral and estimator, as in the scenario wall_flexible_contact"
        )
        raise ScenarioError(("law.gains", text))
    sampling = scenario.sampling
    period = material.time_step if sampling is None else sampling.period
    if not period:
        text = (
            "for a continuous compliant plant without `sampling` no gains are computed; give some, "
            "or a sampling"
        )
        raise ScenarioError(("law.gains", text))
    names = [signal.name for signal in model.dae.output_signals]
    positions, forces = np.split(np.array(names), [len(model.position_signals)])
    integral = law.integral
    if integral is None:
        points = _moved_points(model)
        integral = [name for name in positions if name in points] + forces.tolist()
    stiffness = material.stiffness_on(model, _FORCE)
    force = sensors.force or parts.MeasuredForce(sample_period=period)
    estimator = scenario.estimator or parts.Estimator()
    frictional = [c.friction_parameter for c in model.constraints if c.friction_parameter]
    identify = list(dict.fromkeys([*frictional, *estimator.identify]))
    references, guess, stated = _motion(scenario, model, structure, stiffness)
    begin, given = scenario.integrator.start_time, law.constraint_damping
    with at("law.gains"):
        best = contact_gains(
            model,
            PointMaterial(
                material.time_step,
                stiffness,
                material.dissipation,
                None,
                material.stiction_tolerance,
                material.radius,
            ),
            references,
            LoopSettings(
                sensor=force.sensor(model.dae.num_constraints),
                encoders=sensors.encoders,
                sampling=sampling,
                observer=None if estimator.rate is None else estimator,
            ),
            times=(begin, begin + min(scenario.duration, _LONGEST)),
            guess=guess,
            structure=structure,
            identify=identify,
            integral=integral,
            constraint_damping=None if given is None else given.design(),
            contact_stiffness=stated,
            latency=latency_of(scenario, model),
            roughness=law.largest_roughness,
        )
    # A force of degree 0 has a gain only if it is integrated.
    of_forces = {name: [_rounded(best.force_gain)] for name in forces.tolist() if name in integral}
    of_positions = {
        name: [_rounded(gain) for gain in best.position_gains(3 if name in integral else 2)]
        for name in positions.tolist()
    }
    damping = law.constraint_damping or parts.Poles(all=[-_rounded(best.constraint_damping)])
    if estimator.rate is None:
        own, fast = best.observing, best.observing.state_rate
        estimator = replace(
            estimator,
            rate=_rounded(own.rate),
            force_rate=_rounded(own.force_rate or own.rate),
            friction_rate=_rounded(own.friction_rate),
            identify=identify,
            state_rate=None if fast is None else _rounded(fast),
        )
    task, touch_note = scenario.task, ""
    if task is not None and task.gains is None:
        task = replace(task, gains=_free_gains(scenario, model, best))
    if task is not None:
        mobility = float(np.max(np.diag(structure.constraint_matrix(structure.states[0]))))
        late = period * (1 + (0 if sampling is None else sampling.late_samples))
        least = _least_damping(structure, damping)
        touching = _Touch(stiffness, mobility, least, best.force_gain, period, late)
        task = touching.slowed(task)
        touch_note = touching.note(task)
    chosen = replace(
        scenario,
        task=task,
        law=replace(
            law,
            gains=parts.Coefficients(outputs=of_positions | of_forces),
            integral=integral,
            constraint_damping=damping,
            contact_stiffness=None if task is not None else stated,
            largest_roughness=None,
        ),
        estimator=estimator,
        sensors=replace(sensors, force=force),
    )
    return Completed(chosen, (_note(best, chosen, stiffness) + touch_note,))


def _motion(
    scenario: Scenario, model: RobotModel, structure: Structure, stiffness: float
) -> tuple[list[Reference], FloatArray | None, float | None]:
    """The references along which gains are computed, a state near them, and the law's stiffness.

    That of a task is a small circle, with the force that its contact has in the middle.
    """
    names = [signal.name for signal in model.dae.output_signals]
    degrees = list(structure.output_degrees)
    forces = range(len(model.position_signals), len(names))
    if scenario.task is not None:
        dae, points = model.dae, _moved_points(model)
        state = structure.manifold.project(dae.nominal_state)
        outputs = ca.Function("z", [dae.state, dae.parameter_symbol], [dae.l])
        middle = outputs(state, dae.parameter_values).full()[:, 0]
        middle[list(forces)] = _FORCE
        turns = {name: pi / 2.0 * i for i, name in enumerate(points)}
        return (
            [
                SinusoidReference(value, _ROUND * (name in points), _FAST, turns.get(name, 0.0))
                for name, value in zip(names, middle.tolist(), strict=True)
            ],
            state,
            None,
        )
    with at("start"):
        _, guess = reference_and_start(scenario, model, structure)
    stated = scenario.law.contact_stiffness
    if stated is None:
        for i in forces:
            degrees[i] = 2
        try:
            Deflection.of(structure, stiffness, None)
            return references_of(scenario, names, degrees), guess, stiffness
        except (ModelError, ScenarioError):  # Other outputs, or forces that jump.
            degrees = list(structure.output_degrees)
    return references_of(scenario, names, degrees), guess, stated


def latency_of(scenario: Scenario, model: RobotModel) -> float:
    """The mean time from a sample to the moment when its control acts, for rigid joints, in s.

    A plant that steps by h damps with the speed at the end of each step: h / 2 later than the mean,
    and h later than a law without sampling, which acts at each step.
    """
    sampling, material = scenario.sampling, scenario.plant.material
    step = 0.0 if material is None else material.time_step
    if model.stages:
        return 0.0
    return step if sampling is None else sampling.delay + (sampling.period + step) / 2.0


def _free_gains(scenario: Scenario, model: RobotModel, contact: ContactGains) -> parts.Coefficients:
    """The gains of a task without contact, soft along the distance: see `TaskController`."""
    rate = contact.position_rate / _SOFTER
    gains = {signal.name: contact.position_gains(2) for signal in model.position_signals}
    for point in opening_contact(scenario, model):
        gains[point.residual_signals[0].name] = [rate**2, 2.0 * rate]
    return parts.Coefficients(
        outputs={name: [_rounded(gain) for gain in values] for name, values in gains.items()}
    )


def _least_damping(structure: Structure, damping: parts.Gains) -> float:
    """The least damping of a constraint, in 1/s."""
    with at("law.constraint_damping"):
        return float(np.min(np.diag(damping_gains(structure, damping.design()).matrix)))


def _note(best: ContactGains, chosen: Scenario, stiffness: float) -> str:
    """The choice of gains as sentences."""
    law, estimator = chosen.law, chosen.estimator
    assert estimator is not None
    observed = f"an estimator of {estimator.rate:g} 1/s that identifies: "
    observed += ", ".join(estimator.identify) or "none"
    if estimator.state_rate is not None:
        observed += f", with an estimate of the state of {estimator.state_rate:g} 1/s"
    binds = {
        "roughness": "the roughness of the controls",
        "damping": "the damping of fast modes",
        "decay": "the decay of slow modes",
        "start": "the start",
    }.get(best.binds, "sampling and delay")
    text = (
        f"recommended for a contact of {stiffness:.2g} N/m: Butterworth's poles of positions at "
        f"{_rounded(best.position_rate):g} 1/s, of forces one at {-_rounded(best.force_gain):g} "
        f"1/s, with integrals of {', '.join(law.integral or ())}, damping of the constraint "
        f"{_rounded(best.constraint_damping):g} 1/s, {observed}. "
    )
    if best.binds == "rest":
        text += "The references rest, so that no loop was examined. "
    else:
        text += (
            "On the loop itself, with stiffness and tool's mass from 1/2 to 2 times the model's "
            f"and friction up to 0.8, the slowest mode decays at {best.decay:.2g} 1/s, and the "
            f"least damping ratio is {best.damping:.2g}; {binds} keeps the gains from being "
            "faster. "
        )
    text += (
        f"Noise changes the controls by {best.roughness:.2g} N m from sample to sample. Expected "
        f"are {1e3 * best.position_error:.2g} mm and {best.force_error:.2g} N rms, if an unknown "
        f"force of {FORCE:g} N appears every {EVERY:g} s"
    )
    if best.margin >= 1.0:
        return text
    return (
        f"{text}. {DECAY:g} 1/s and {DAMPING:g} are recommended: more inertia at the tool, a "
        "shorter delay, a softer contact or less noise would help"
    )


def _moved_points(model: RobotModel) -> list[str]:
    """The names of outputs that are coordinates of points."""
    return [
        signal.name
        for output in model.outputs
        for signal in output.signals(model.links)
        if signal.unit == "m"
    ]


def _rounded(value: float) -> float:
    """A recommended number, rounded to three digits for a scenario file."""
    return float(f"{value:.3g}")


@dataclass(frozen=True)
class _Touch:
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

        with the depth d and the reference lambda, fading from the felt force to the goal. F is
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
        reference = goal + (felt - goal) * (powers @ fading(SMOOTH)[0])
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
                phases[index] = replace(
                    phase, speed=_rounded(min(phase.speed_of_approach, lasting))
                )
        return replace(task, phases=phases)

    def _lasting(self, task: ScenarioTask, press: Press) -> float:
        if isinstance(press.force, Reference):
            return inf
        return self.lasting_speed(task.contact_force, press.force, press.over)

    def note(self, task: ScenarioTask) -> str:
        """A sentence on the largest expected force of a touch, F + v (sqrt(k / A) + k t).

        The contact of stiffness k stops the effective mass 1 / A of the tool from the speed v, and
        in the time t until the law reacts the tool moves on by v t.
        """
        k, peaks = self.stiffness, []
        approaches = [phase for phase in task.make().phases if isinstance(phase, Approach)]
        for phase in approaches:
            felt, speed = phase.felt(task.contact_force), phase.speed_of_approach
            peak = felt + speed * ((k / self.mobility) ** 0.5 + k * self.late)
            peaks.append((peak, speed, phase.name))
        if not peaks:
            return ""
        peak, speed, name = max(peaks)
        which = f" by {name}" if len(peaks) > 1 else ""
        return f". A touch{which} at {speed:g} m/s is expected to stay below {peak:.3g} N"
