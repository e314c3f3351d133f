"""The gains that a scenario with compliant contact leaves out, and what belongs to them."""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, pi

import casadi as ca
import numpy as np
from scipy.linalg import expm

from drake_dae.arrays import FloatArray
from drake_dae.dae import (
    AdvisedGains,
    ContactGains,
    SensedContact,
    SensorNoise,
    Structure,
    ZeroDynamics,
    advised_gains,
    contact_gains,
)
from drake_dae.dae.beyond.advised_gains import EVERY, MODEL_ERROR, settles_along
from drake_dae.dae.law_model import damping_gains
from drake_dae.dae.margins import ContactMargins
from drake_dae.errors import DrakeDaeError, GainError, ScenarioError
from drake_dae.references import Reference
from drake_dae.robots import RobotModel, velocities_are_rates
from drake_dae.scenario import parts as parts
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.estimated import estimates_all
from drake_dae.scenario.form import at
from drake_dae.scenario.model import exogenous_references, reference_and_start, references_of
from drake_dae.scenario.parts import ScenarioTask
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import opening_contact
from drake_dae.systems.task.automaton import SMOOTH, fading
from drake_dae.systems.task.phases import Approach, Press

_SOFTER = 5.0
"""The ratio of the poles of positions to those of the distance, of a robot without contact."""

NOISE = 1e-3
"""The standard deviation of velocity noise in rad/s, without encoders."""

_FORCE = 10.0
"""The force in N at which the stiffness of a hydroelastic patch is evaluated."""

_SHARE = 0.003
"""The default of the largest roughness, as a fraction of the largest effort limit."""

_STATES = 33
"""The number of states along the references at which friction is compared with what jams."""

_DEVELOPED = 10.0
"""The factor of velocities, so that friction of the model is that of a contact that slides."""

_PERIODS = 3
"""The number of oscillations of the contact after the force of a touch has reached its goal."""


def advised(scenario: Scenario, model: RobotModel, structure: Structure) -> Completed:
    """Computes gains and other settings that a scenario in Drake's own contact leaves out.

    It computes gains, integrals of forces and of points, constraint damping, an estimator of
    disturbance and friction, and measured force, each if it is left out; and for a task the gains
    without contact, soft along the distance. With encoders and rigid joints the gains are those of
    `advised_gains` for the noise of the encoders; otherwise those of `contact_gains`. A scenario
    with `law.gains`, or with ideal contact, is unchanged.

    Args:
        scenario: The scenario, with all of its outputs.
        model: Its robot.
        structure: The structure of the model's system.

    Returns:
        The scenario, and the choices in words.

    Raises:
        ScenarioError: There are no default gains for such a scenario, or none are smooth and stable
            enough; or `largest_roughness` or `largest_errors` is given and not used.
    """
    material = scenario.plant.material
    law, sensors = scenario.law, scenario.sensors
    _check_bounds(scenario)
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
    late = 0 if sampling is None else sampling.late_samples
    mobility = float(np.max(np.diag(structure.constraint_matrix(structure.states[0]))))
    stiffness = material.stiffness_on(model, _FORCE)
    fast = None
    known_by, outlook = f"velocities within {NOISE:.2g} rad/s", ""
    efforts = model.control_limits[np.isfinite(model.control_limits)]
    if sensors.encoders is None:
        contact = contact_gains(stiffness, mobility, period, late, NOISE)
    else:
        sensed = sensed_contact(scenario, model, structure, (period, late), stiffness)
        roughness = law.largest_roughness
        if roughness is None:
            roughness = _SHARE * float(np.max(efforts)) if efforts.size else 1.0
        bounds = {} if law.largest_errors is None else vars(law.largest_errors)
        errors = {f"{name}_error": most for name, most in bounds.items() if most is not None}
        with at("law.gains"):
            try:
                best, bare = advised_gains(sensed, roughness, **errors), ""
            except GainError:
                # Gains of a contact of half the stiffness are stable up to twice that.
                softer = replace(sensed, stiffness=stiffness / 2.0)
                if settles_along(sensed) or not settles_along(softer):
                    raise
                best = advised_gains(softer, roughness, **errors)
                bare = ". A contact that is stiffer than stated may be unstable: sample more often"
        contact, fast = best.gains, best.state_rate
        known_by, outlook = "these encoders", f". {_predicted(best)}{bare}"
    names = [signal.name for signal in model.dae.output_signals]
    positions, forces = np.split(np.array(names), [len(model.position_signals)])
    points = _moved_points(model)
    integral = law.integral
    if integral is None:
        integral = [name for name in positions if name in points] + forces.tolist()
    force = sensors.force or parts.MeasuredForce(sample_period=period)
    # A force of degree 0 has a gain only if it is integrated.
    of_forces = {
        name: [_rounded(contact.force_gain)] for name in forces.tolist() if name in integral
    }
    of_positions = {
        name: [_rounded(gain) for gain in contact.position_gains(3 if name in integral else 2)]
        for name in positions.tolist()
    }
    gains = parts.Coefficients(outputs=of_positions | of_forces)
    damping = law.constraint_damping
    if damping is None and contact.constraint_damping:
        damping = parts.Poles(all=[-_rounded(contact.constraint_damping)])
    estimator = scenario.estimator or parts.Estimator()
    frictional = [c.friction_parameter for c in model.constraints if c.friction_parameter]
    if estimator.rate is None:
        estimator = replace(
            estimator,
            rate=_rounded(contact.observer_rate),
            force_rate=_rounded(contact.observer_force_rate),
            friction_rate=_rounded(contact.friction_rate),
            parameters=None
            if estimator.parameters is None
            else list(dict.fromkeys([*frictional, *estimator.parameters])),
            state_rate=None if fast is None else _rounded(fast),
        )
    if not estimates_all(replace(scenario, estimator=estimator), model):
        named = frictional if estimator.parameters is None else estimator.parameters
        estimator = replace(estimator, parameters=named)
    task = scenario.task
    if task is not None and task.gains is None:
        task = replace(task, gains=_free_gains(scenario, model, contact))
    touch_note = ""
    if task is not None:
        touching = _Touch(
            stiffness,
            mobility,
            contact.constraint_damping if damping is None else _least_damping(structure, damping),
            contact.force_gain,
            period,
            period * (1 + late),
        )
        task = touching.slowed(task)
        touch_note = touching.note(task)
    chosen = replace(
        scenario,
        task=task,
        law=replace(
            law,
            gains=gains,
            integral=integral,
            constraint_damping=damping,
            contact_stiffness=scenario.law.contact_stiffness
            if fast is not None  # By encoders alone forces got worse.
            else _fed_ahead(scenario, structure, stiffness),
            largest_roughness=None,
            largest_errors=None,
        ),
        estimator=estimator,
        sensors=replace(sensors, force=force),
    )
    named = estimator.parameters or []
    identified = ", ".join(name for name in named if name in frictional) or "none"
    if estimator.parameters is None:
        identified = "friction, loads, tilts and places of planes"
        if scenario.compliances is not None:
            identified = "friction and loads"
    estimated = "" if fast is None else f", and an estimate of the state of {_rounded(fast):g} 1/s"
    note = (
        f"recommended for a contact of {stiffness:.2g} N/m and {mobility:.2g} 1/kg, samples of "
        f"{period:g} s and {known_by}: Butterworth's poles of positions "
        f"at {_rounded(contact.position_rate):g} 1/s, and of forces one at "
        f"{-_rounded(contact.force_gain):g} 1/s, with integrals of {', '.join(integral)}, damping "
        f"of the constraint {_rounded(contact.constraint_damping):g} 1/s, an estimator of "
        f"{estimator.rate:g} 1/s that identifies: {identified}{estimated}"
        f"{outlook}"
        f"{touch_note}"
    )
    jam = _jam(scenario, model, structure, material.friction)
    return Completed(chosen, (note, jam) if jam else (note,))


def _jam(
    scenario: Scenario, model: RobotModel, structure: Structure, friction: float | None
) -> str:
    """Where friction of the plant makes contacts jam along the references, as a sentence.

    Along a normal that hardly moves, friction that the law does not know may move the tool into
    the surface by more than the normal force moves it out: mu A_nt > A_nn, the Painleve paradox.
    """
    system = model.dae
    if scenario.task is not None or not (system.frictional_contacts and friction):
        return ""
    begin = scenario.integrator.start_time
    times = np.linspace(begin, begin + scenario.duration, _STATES)
    try:
        reference, start = reference_and_start(scenario, model, structure)
        exogenous = exogenous_references(scenario, system)
        motion = ZeroDynamics(system, structure=structure).motion(
            reference, times, start, exogenous=exogenous
        )
    except DrakeDaeError:  # What is wrong with references and start is told where they are used.
        return ""
    if not motion.times.size:
        return ""
    states = motion.states.copy()
    states[:, model.links.q.numel() :] *= _DEVELOPED
    margins = ContactMargins(system, structure.elimination.constraint_matrix)
    margin = margins.along(motion.times, states, motion.parameters)
    if not margin.lowest <= friction:
        return ""
    name = max(margin.critical_friction, key=margin.critical_friction.__getitem__)
    return (
        f"no gains are stable here: with {name} of {margin.lowest:.2g} or more the contact jams at "
        f"t = {margin.time:.3g} s (the Painleve paradox: friction presses the tool on by more than "
        f"the surface presses it back), and the plant has {friction:g}; start in a posture from "
        "which the tool moves more easily along the normal, or reduce the friction"
    )


def _fed_ahead(scenario: Scenario, structure: Structure, stiffness: float) -> float | None:
    """The stiffness by which the deflection of contacts is fed ahead, if the references allow it.

    All constraint forces are outputs then, with references that have two derivatives.
    """
    system, given = structure.system, scenario.law.contact_stiffness
    if given is not None or scenario.task is not None:
        return given
    names, degrees = [s.name for s in system.output_signals], list(structure.output_degrees)
    forces = [s.name for s in system.constraint_input_signals]
    of_forces = [i for i, name in enumerate(names) if name in forces]
    is_fit = len(of_forces) == len(forces) and {*structure.constraint_degrees} == {2}
    if not is_fit or any(degrees[i] for i in of_forces):
        return None
    degrees = [2 if i in of_forces else degree for i, degree in enumerate(degrees)]
    try:
        references_of(scenario, names, degrees)
    except ScenarioError:
        return None
    return _rounded(stiffness)


def _check_bounds(scenario: Scenario) -> None:
    """Refuses bounds for computed gains where none are computed by them."""
    is_used, law = scenario.is_advised and scenario.sensors.encoders is not None, scenario.law
    for name in ("largest_roughness", "largest_errors"):
        if getattr(law, name) is not None and not is_used:
            text = (
                "it is used only for gains that are computed for rigid joints with encoders in "
                "Drake's contact; leave it out, or leave `law.gains` out and give encoders"
            )
            raise ScenarioError((f"law.{name}", text))


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


def sensed_contact(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    timing: tuple[float, int],
    stiffness: float,
) -> SensedContact:
    """Collects the data on a robot, its contact and its sensors for the choice of gains.

    Args:
        scenario: The scenario, with encoders.
        model, structure: Its robot.
        timing: The period in s and the delay in samples.
        stiffness: The stiffness of the contact in N/m.
    """
    system, state, encoders = model.dae, structure.states[0], scenario.sensors.encoders
    assert encoders is not None
    velocities = slice(model.links.q.numel(), 2 * model.links.q.numel())
    rows, moved = system.l.numel(), _moved_points(model)
    points = [i for i in range(rows) if system.output_signals[i].name in moved]
    x, mass = system.state, system.mass_matrix[velocities, velocities]
    reads = ca.vertcat(system.l[points], system.k)
    slopes = ca.jacobian(reads, x)[:, : model.links.q.numel()]
    function = system.trace("levers", {"slopes": slopes, "mass": mass}, often=False)
    values = function(state, system.parameter_values)
    jacobian, inertia = values[0].reshape(reads.numel(), -1), values[1]
    moves = np.einsum("ij,ji->i", jacobian, np.linalg.solve(inertia, jacobian.T))
    levers = np.linalg.norm(jacobian, axis=1)
    free, contact = slice(len(points)), slice(len(points), None)
    estimator = scenario.estimator
    may_estimate = estimator is None or estimator.rate is None or estimator.state_rate is not None
    has_rates = encoders.velocity_bandwidth is None and velocities_are_rates(model.links)
    period, delay = timing
    return SensedContact(
        period=period,
        delay=delay,
        stiffness=stiffness,
        mobility=float(np.max(moves[contact])),
        free_mobility=float(np.max(moves[free], initial=np.max(moves[contact]))),
        lever=float(np.max(levers[free], initial=np.max(levers[contact]))),
        contact_lever=float(np.max(levers[contact])),
        inertia=float(np.linalg.norm(inertia)),
        noise=SensorNoise(
            position=float(np.max(encoders.position_deviation)),
            velocity=float(np.max(np.asarray(encoders.velocity_noise, dtype=float))),
            force=float(np.max(scenario.sensors.force_noise)),
            velocity_bandwidth=encoders.velocity_bandwidth or 0.0,
        ),
        estimates=may_estimate and has_rates,
    )


def _predicted(best: AdvisedGains) -> str:
    """The errors from which gains were chosen, as sentences."""
    by_noise = f"{1e3 * best.noise_error:.2g} mm and {best.noise_force:.2g} N"
    return (
        "These gains are the best for one direction alone: "
        f"{1e3 * best.position_error:.2g} mm and {best.force_error:.2g} N rms "
        f"if an unknown force of {MODEL_ERROR:g} N appears every {EVERY:g} s, {by_noise} of it by "
        f"noise, and a change of the controls of {best.roughness:.2g} N m from sample to sample"
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
