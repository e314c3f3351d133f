"""What is to be expected of a law on contact that gives way: errors, touches, and jams."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf, isfinite, pi

import casadi as ca
import numpy as np
from scipy.linalg import expm

from drake_dae.arrays import FloatArray
from drake_dae.dae import SensedContact, SensorNoise, Structure
from drake_dae.dae.advised_gains import EVERY, MODEL_ERROR, RAMP, Part
from drake_dae.dae.law_model import damping_gains
from drake_dae.dae.margins import ContactMargins
from drake_dae.dae.one_direction import DirectionGains
from drake_dae.diagrams.record import Record
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.references import Reference
from drake_dae.robots import RobotModel, velocities_are_rates
from drake_dae.running.judgement import OutputQuality
from drake_dae.scenario import parts as parts
from drake_dae.scenario.form import at
from drake_dae.scenario.model import motion_along
from drake_dae.scenario.parts import ScenarioTask
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.automaton import SMOOTH, fading
from drake_dae.systems.phases import Approach, Press
from drake_dae.systems.sensors import Encoders

PATCH_FORCE = 10.0  # The force in N at which the stiffness of a hydroelastic patch is evaluated.
_BEYOND = 2.0  # A run is reported whose errors exceed the stated ones by this factor.
_PERIODS = 3  # The oscillations of the contact after the force of a touch has reached its goal.
# The number of states along the references at which friction is compared with what jams; and the
# factor of their velocities, so that friction of the model is that of a contact that slides.
_STATES, _DEVELOPED = 33, 10.0


def timing(scenario: Scenario) -> tuple[float, int]:
    """The period of samples in s, 0 for none, and the delay of the control in samples."""
    sampling, material = scenario.sampling, scenario.plant.material
    if sampling is not None:
        return sampling.period, sampling.late_samples
    return 0.0 if material is None else material.time_step, 0


def moved_points(model: RobotModel) -> list[str]:
    """The names of outputs that are coordinates of points."""
    signals = (s for output in model.outputs for s in output.signals(model.links))
    return [signal.name for signal in signals if signal.unit == "m"]


def rounded(value: float) -> float:
    """A recommended number, rounded to three digits for a scenario file."""
    return float(f"{value:.3g}")


def sensed_contact(
    scenario: Scenario, model: RobotModel, structure: Structure, stiffness: float
) -> SensedContact:
    """A robot, its contact of a stiffness in N/m, and its sensors, exact without encoders."""
    system, state = model.dae, structure.states[0]
    encoders = scenario.sensors.encoders or Encoders()
    velocities = slice(model.links.q.numel(), 2 * model.links.q.numel())
    rows, moved = system.l.numel(), moved_points(model)
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
    period, delay = timing(scenario)
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


def stated_errors(
    scenario: Scenario, model: RobotModel, structure: Structure
) -> tuple[float, float] | None:
    """The rms errors of a point in m and of a force in N by the linear model of `advised_gains`.

    With the gains as they run, the noise of the sensors, an unknown force, a changing reference,
    and the bias of the force sensor, which no law knows. None where that model says nothing.
    """
    law, estimator, material = scenario.law, scenario.estimator, scenario.plant.material
    if material is None or scenario.task is not None or not timing(scenario)[0]:
        return None
    if estimator is None or not estimator.rate or not isinstance(law.gains, parts.Coefficients):
        return None
    gains = law.gains.outputs
    pressing = {signal.name for signal in model.dae.constraint_input_signals}
    of_points = [gains[name] for name in moved_points(model) if name in gains]
    of_forces = [own for name, own in gains.items() if name in pressing]
    if not of_points or not of_forces or len(of_points[0]) not in (2, 3):
        return None
    sensed = sensed_contact(scenario, model, structure, material.stiffness_on(model, PATCH_FORCE))
    damped = least_damping(structure, law.constraint_damping)
    integral, stiff, rate = (0.0, *of_points[0])[-3:]
    slow = estimator.force_rate or estimator.rate
    rates = (
        DirectionGains((integral, stiff, rate), 0.0, estimator.rate, estimator.state_rate),
        DirectionGains((0.0, 0.0, damped), of_forces[0][0], slow, estimator.state_rate),
    )
    try:
        across, along = (Part.of(sensed, 0.0, own, bool(i)).error for i, own in enumerate(rates))
    except ModelError:  # Of a state_rate, which is reported where it is used.
        return None
    found = across, float(np.hypot(along, _bias(scenario)))
    return found if isfinite(sum(found)) else None


def beyond_stated(
    scenario: Scenario,
    model: RobotModel,
    structure: Structure,
    outputs: Sequence[OutputQuality],
    record: Record,
) -> str:
    """Which assumption failed if the errors of a run are beyond the stated ones, or ""."""
    stated = stated_errors(scenario, model, structure)
    if stated is None:
        return ""
    points, late = moved_points(model), record.time >= record.time[[0, -1]].mean()
    pressing = [signal.name for signal in model.dae.constraint_input_signals]
    found = [
        float(np.linalg.norm([o.late_rms for o in outputs if o.signal.name in names]))
        for names in (points, pressing)
    ]
    if all(own <= _BEYOND * most for own, most in zip(found, stated, strict=True)):
        return ""
    names = [signal.name for signal in record.signals["desired_output"].signals]
    wanted = record["desired_output"][late][:, [name in pressing for name in names]]
    step = np.gradient(wanted, record.time[late], axis=0)
    slope, least = float(np.sqrt(np.mean(step**2))), np.min(record["constraint_force"][late])
    estimator = scenario.estimator
    causes = {
        "drives were at their limits": "excess" in record and bool(record["excess"].any()),
        "the contact was lost": estimator is not None and least < estimator.least_force,
        f"the reference of the force changes by {slope:.2g} N/s rms": slope > RAMP,
    }
    failed = [cause for cause, holds in causes.items() if holds]
    if not failed:
        unknown = "is wrong by more than that"
        if estimator is not None and estimator.parameters is not None:
            unknown += "; only " + (", ".join(estimator.parameters) or "a disturbance")
            unknown += " is estimated"
        failed = [f"the law's model {unknown}"]
    return (
        f"errors of {1e3 * found[0]:.2g} mm and {found[1]:.2g} N rms, where "
        f"{expected(scenario, stated)}: {', '.join(failed)}"
    )


def expected(scenario: Scenario, stated: Sequence[float]) -> str:
    """Stated errors, in words."""
    bias = _bias(scenario)
    own = f", {bias:.2g} N of it by the bias of the force sensor," * bool(bias)
    return (
        f"{1e3 * stated[0]:.2g} mm and {stated[1]:.2g} N rms{own} are expected if an unknown force "
        f"of {MODEL_ERROR:g} N appears every {EVERY:g} s and references of forces change by "
        f"{RAMP:g} N/s"
    )


def _bias(scenario: Scenario) -> float:
    """The largest bias of a measured force, which no law knows, in N."""
    force = scenario.sensors.force
    return 0.0 if force is None else float(np.max(np.abs(np.asarray(force.bias, dtype=float))))


def least_damping(structure: Structure, damping: parts.Gains | None) -> float:
    """The least damping of a constraint by the law, in 1/s."""
    if damping is None:
        return 0.0
    with at("law.constraint_damping"):
        return float(np.min(np.diag(damping_gains(structure, damping.design()).matrix)))


def jam(scenario: Scenario, model: RobotModel, structure: Structure, friction: float | None) -> str:
    """Where friction of the plant makes contacts jam along the references, as a sentence.

    Along a normal that hardly moves, friction that the law does not know may move the tool into
    the surface by more than the normal force moves it out: mu A_nt > A_nn, the Painleve paradox.
    """
    system = model.dae
    if scenario.task is not None or not (system.frictional_contacts and friction):
        return ""
    try:
        motion = motion_along(scenario, model, structure, _STATES)
    except DrakeDaeError:  # Wrong references and starts are reported where they are used.
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


def with_lasting_touches(
    task: ScenarioTask,
    stiffness: float,
    mobility: float,
    damping: float,
    force_gain: float,
    period: float,
    late: float,
) -> tuple[ScenarioTask, str]:
    """The task whose touches do not open again, and a sentence on their largest expected force.

    The law holds for each sample T the force

        u = lambda + K_i sum (lambda - F) T - c d' / A,    d'' = A (u - F),    F = k d,

    with the depth d, and the reference lambda that fades from the felt force to the goal. F is
    linear in the speed v of a touch, F = F_lambda(t) + v F_v(t), so that the largest v is the least
    F_lambda / -F_v of all times with F_v < 0. An Approach without a speed has this one, or its
    default if that is lower. The largest force is F + v (sqrt(k / A) + k t): the contact stops the
    mass 1 / A of the tool, which moves on for the time t until the law reacts.
    """
    k, A = stiffness, mobility
    step = expm(period * np.array([[0.0, 1.0, 0.0], [-A * k, 0.0, A], [0.0, 0.0, 0.0]]))

    def force(depth: float, rate: float, reference: FloatArray) -> FloatArray:
        """F at each sample after a touch."""
        waiting = [k * depth] * (round(late / period) - 1)
        integral, forces = 0.0, np.empty(reference.size)
        for index, wanted in enumerate(reference.tolist()):
            forces[index] = felt = k * depth
            waiting.append(wanted + force_gain * integral - damping * rate / A)
            integral += period * (wanted - felt)
            depth, rate, _ = step @ [depth, rate, waiting.pop(0)]
        return forces

    phases, felt = list(task.phases), task.contact_force
    for index, (phase, then) in enumerate(pairwise(phases)):
        if not (isinstance(phase, Approach) and phase.speed is None and isinstance(then, Press)):
            continue
        speed = phase.speed_of_approach
        if not isinstance(then.force, Reference):
            times = np.arange(0.0, then.over + 2.0 * pi * _PERIODS / (k * A) ** 0.5, period)
            powers = np.minimum(times / then.over, 1.0)[:, None] ** np.arange(6)
            reference = then.force + (felt - then.force) * (powers @ fading(SMOOTH)[0])
            of_speed, of_reference = force(0.0, 1.0, 0.0 * reference), force(felt / k, 0, reference)
            opens = of_speed < 0.0
            lasting = np.min(of_reference[opens] / -of_speed[opens], initial=inf)
            speed = min(speed, float(lasting))
        phases[index] = replace(phase, speed=rounded(speed))
    task = replace(task, phases=phases)
    reach = (k / A) ** 0.5 + k * late
    approaches = [phase for phase in task.make().phases if isinstance(phase, Approach)]
    peaks = [(p.felt(felt) + p.speed_of_approach * reach, p) for p in approaches]
    if not peaks:
        return task, ""
    peak, phase = max(peaks, key=lambda pair: (pair[0], pair[1].speed_of_approach, pair[1].name))
    which = f" by {phase.name}" if len(peaks) > 1 else ""
    speed = phase.speed_of_approach
    return task, f". A touch{which} at {speed:g} m/s is expected to stay below {peak:.3g} N"
