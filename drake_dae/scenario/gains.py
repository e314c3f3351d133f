"""Gains for a contact that gives way: computed from it and its sensors, and what they lead to."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf, isfinite, pi

import casadi as ca
import numpy as np
from scipy.linalg import expm

from drake_dae.arrays import FloatArray
from drake_dae.dae import (
    AdvisedGains,
    SensedContact,
    SensorNoise,
    Structure,
    advised_gains,
    contact_gains,
)
from drake_dae.dae.advised_gains import EVERY, MODEL_ERROR, RAMP, Part, settles_along
from drake_dae.dae.law_model import damping_gains
from drake_dae.dae.margins import ContactMargins
from drake_dae.dae.one_direction import DirectionGains
from drake_dae.errors import DrakeDaeError, ModelError, ScenarioError
from drake_dae.references import Reference
from drake_dae.robots import JointFriction, Plane, PointOnSurface, RobotModel, velocities_are_rates
from drake_dae.scenario import parts
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.form import at
from drake_dae.scenario.model import motion_along, references_of
from drake_dae.scenario.parts import ScenarioTask
from drake_dae.scenario.robot_file.robot import Payload
from drake_dae.scenario.scenario import Scenario, WrittenConstraint
from drake_dae.scenario.start import opening_contact
from drake_dae.systems.automaton import SMOOTH, fading
from drake_dae.systems.phases import Approach, Press
from drake_dae.systems.sensors import Encoders

_SOFTER = 5.0  # The ratio of the poles of positions to those of the distance, without contact.
NOISE = 1e-3  # The standard deviation of velocity noise in rad/s, without encoders.
_SHARE = 0.003  # The default of the largest roughness, as a fraction of the largest effort limit.
LEAST_MASS = 1e-6  # The mass in kg of a load that nobody has stated; masses are positive.
_EFFORT = 100.0  # The largest effort in N m of drives without limits in the file.
# The largest load relative to the robot's mass, and its largest distance from its frame in m; the
# largest tilt in rad and displacement in m of a plane; and the largest friction of a joint in N m,
# and in N m per rad/s, relative to its largest effort.
_LOAD, _CENTER, _TILT, _PLACE, _COULOMB, _VISCOUS = 0.2, 0.2, 0.15, 0.01, 0.1, 0.25
PATCH_FORCE = 10.0  # The force in N at which the stiffness of a hydroelastic patch is evaluated.
_PERIODS = 3  # The oscillations of the contact after the force of a touch has reached its goal.
# The number of states along the references at which friction is compared with what jams; and the
# factor of their velocities, so that friction of the model is that of a contact that slides.
_STATES, _DEVELOPED = 33, 10.0


def advised(scenario: Scenario, model: RobotModel, structure: Structure) -> Completed:
    """The scenario with gains of `advised_gains` or `contact_gains`, and what belongs to them."""
    material, law, sensors = scenario.plant.material, scenario.law, scenario.sensors
    for name in ("largest_roughness", "largest_errors"):
        is_used = scenario.is_advised and sensors.encoders is not None
        if getattr(law, name) is not None and not is_used:
            text = (
                "it is used only if `law.gains` is left out, `sensors.encoders` is given, and the "
                "plant is !CompliantContact or !MultibodyPlant; leave it out, or change these"
            )
            raise ScenarioError((f"law.{name}", text))
    if material is None or not scenario.is_advised:
        return Completed(scenario)
    period, late = timing(scenario)
    if model.stages or not period:
        text = (
            "no gains are computed if the robot has springs, motors or valves, nor for a "
            "continuous compliant plant without `sampling`. Give gains, integral and estimator, as "
            "in the scenario wall_flexible_contact"
        )
        raise ScenarioError(("law.gains", text))
    mobility = float(np.max(np.diag(structure.constraint_matrix(structure.states[0]))))
    stiffness = material.stiffness_on(model, PATCH_FORCE)
    fast, known_by, outlook = None, f"velocities within {NOISE:.2g} rad/s", ""
    if sensors.encoders is None:
        contact = contact_gains(stiffness, mobility, period, late, NOISE)
    else:
        with at("law.gains"):
            best, outlook = _sensed_gains(scenario, model, structure, stiffness)
        contact, fast, known_by = best.gains, best.state_rate, "these encoders"

    # The law. A force of degree 0 has a gain only if it is integrated.
    names = [signal.name for signal in model.dae.output_signals]
    positions, forces = names[: len(model.position_signals)], names[len(model.position_signals) :]
    integral, points = law.integral, moved_points(model)
    if integral is None:
        integral = [name for name in positions if name in points] + forces
    of_outputs = {n: contact.position_gains(3 if n in integral else 2) for n in positions}
    of_outputs |= {name: [contact.force_gain] for name in forces if name in integral}
    damping = law.constraint_damping
    if damping is None and contact.constraint_damping:
        damping = parts.Poles(all=[-rounded(contact.constraint_damping)])

    # The estimator.
    estimator = scenario.estimator or parts.Estimator()
    frictional = [c.friction_parameter for c in model.constraints if c.friction_parameter]
    if estimator.rate is None:
        named = estimator.parameters
        estimator = replace(
            estimator,
            rate=rounded(contact.observer_rate),
            force_rate=rounded(contact.observer_force_rate),
            friction_rate=rounded(contact.friction_rate),
            parameters=None if named is None else list(dict.fromkeys([*frictional, *named])),
            state_rate=None if fast is None else rounded(fast),
        )
    given = replace(scenario, estimator=estimator)
    if estimator.parameters is None and not estimates_all(given, model):
        estimator = replace(estimator, parameters=frictional)

    # The task: soft along the distance while the contact is open, see `TaskController`.
    task = scenario.task
    if task is not None:
        if task.gains is None:
            free = {signal.name: contact.position_gains(2) for signal in model.position_signals}
            rate = contact.position_rate / _SOFTER
            distance = opening_contact(scenario, model).residual_signals[0].name
            free[distance] = [rate**2, 2.0 * rate]
            task = replace(task, gains=_coefficients(free))
        acting = least_damping(structure, damping), contact.force_gain, period, late
        task = with_lasting_touches(task, stiffness, mobility, *acting)
    chosen = replace(
        scenario,
        task=task,
        law=replace(
            law,
            gains=_coefficients(of_outputs),
            integral=integral,
            constraint_damping=damping,
            contact_stiffness=_fed_ahead(scenario, structure, stiffness),
            largest_roughness=None,
            largest_errors=None,
        ),
        estimator=estimator,
        sensors=replace(sensors, force=sensors.force or parts.MeasuredForce(sample_period=period)),
    )

    # What it is, in words.
    stated, named = stated_errors(chosen, model, structure), estimator.parameters
    identified = ", ".join(name for name in named or () if name in frictional) or "none"
    if named is None:
        planes = ", tilts and places of planes" * (scenario.compliances is None)
        identified = f"friction, loads{planes}"
    shape = "Butterworth's" if contact.position_damping < 0.75 else "equal"
    estimated = "" if fast is None else f", and an estimate of the state of {rounded(fast):g} 1/s"
    note = (
        f"recommended for a contact of {stiffness:.2g} N/m and {mobility:.2g} 1/kg, samples of "
        f"{period:g} s and {known_by}: {shape} poles of positions "
        f"at {rounded(contact.position_rate):g} 1/s, and of forces one at "
        f"{-rounded(contact.force_gain):g} 1/s, with integrals of {', '.join(integral)}, damping "
        f"of the constraint {rounded(contact.constraint_damping):g} 1/s, an estimator of "
        f"{estimator.rate:g} 1/s that identifies: {identified}{estimated}"
        f"{outlook}{f'. {expected(chosen, stated)}' if stated else ''}"
    )
    told = note, jam(scenario, model, structure, material.friction)
    return Completed(chosen, tuple(filter(None, told)))


def _coefficients(gains: Mapping[str, Sequence[float]]) -> parts.Coefficients:
    return parts.Coefficients(outputs={n: [*map(rounded, own)] for n, own in gains.items()})


def _sensed_gains(
    scenario: Scenario, model: RobotModel, structure: Structure, stiffness: float
) -> tuple[AdvisedGains, str]:
    """The gains for a contact and encoders, and what is predicted for them, in words."""
    law, bare = scenario.law, ""
    sensed = sensed_contact(scenario, model, structure, stiffness)
    efforts = model.control_limits[np.isfinite(model.control_limits)]
    roughness = law.largest_roughness or _SHARE * float(np.max(efforts, initial=0.0)) or 1.0
    bounds = {} if law.largest_errors is None else vars(law.largest_errors)
    errors = {f"{name}_error": most for name, most in bounds.items() if most is not None}
    softer = sensed
    if not settles_along(sensed):
        # Gains of the stiffest softer contact that has some: they are stable up to twice that, and
        # slow beside the oscillation of a stiffer one, which its own dissipation damps.
        softened = (replace(sensed, stiffness=stiffness / 2.0**i) for i in range(1, 11))
        softer = next(filter(settles_along, softened), sensed)
        bare = (
            f". They are those of {softer.stiffness:.2g} N/m, since none are stable with a margin "
            "at the stated stiffness, where the contact may oscillate: sample more often"
        )
    best = advised_gains(softer, roughness, **errors)
    return best, (
        ". These gains are the best for one direction alone, "
        f"{1e3 * best.free.by_noise:.2g} mm and {best.contact.by_noise:.2g} N rms by noise, and a "
        f"change of the controls of {best.roughness:.2g} N m from sample to sample{bare}"
    )


def _fed_ahead(scenario: Scenario, structure: Structure, stiffness: float) -> float | None:
    """The stiffness by which the deflection of contacts is fed ahead, if references allow it."""
    system, given = structure.system, scenario.law.contact_stiffness
    if given is not None or scenario.task is not None:
        return given
    # All constraint forces are outputs then, with references that have two derivatives.
    names = [signal.name for signal in system.output_signals]
    forces = [signal.name for signal in system.constraint_input_signals]
    degrees = dict(zip(names, structure.output_degrees, strict=True))
    if {*structure.constraint_degrees} != {2} or any(degrees.get(name, 1) for name in forces):
        return None
    try:
        references_of(scenario, names, [*(degrees | dict.fromkeys(forces, 2)).values()])
    except ScenarioError:
        return None
    return rounded(stiffness)


def estimates_all(scenario: Scenario, model: RobotModel) -> bool:
    """Whether an estimator of rigid joints may estimate what it can."""
    estimator, material = scenario.estimator, scenario.plant.material
    if estimator is None or estimator.parameters is not None or material is None:
        return False
    surfaces = [c.surface for c in scenario.constraints if isinstance(c, PointOnSurface)]
    is_plain = all(isinstance(surface, Plane) for surface in surfaces)  # On a sphere it got worse.
    is_rigid = not model.stages and velocities_are_rates(model.links)
    return is_plain and is_rigid and not scenario.exogenous


def estimating_all(scenario: Scenario, model: RobotModel) -> Scenario:
    """The scenario of a law whose estimator knows a load at each contact, planes and friction."""
    assert scenario.estimator is not None
    robot, frictional, constraints = scenario.robot, list[str](), list[WrittenConstraint]()
    ranges, loads = dict[str, float](), dict[str, Payload]()
    known = {p.name for p in model.dae.parameters}
    masses = [p.value[0] for p in model.dae.parameters if p.name.endswith(".mass")]
    for constraint in scenario.constraints:
        if isinstance(constraint, PointOnSurface):
            constraint = replace(constraint, friction=constraint.friction or 0.0)
            frictional.append(f"{constraint.name}.friction")
            if scenario.compliances is None:  # Surfaces of redundant constraints are not estimated.
                constraint = replace(constraint, rpy=constraint.rpy or (0.0, 0.0, 0.0))
                ranges[f"{constraint.name}.rpy"] = _TILT
                ranges[f"{constraint.name}.position"] = _PLACE
            if constraint.frame not in loads:
                name = constraint.frame.replace("::", "_") + "_load"
                loads[constraint.frame] = Payload(constraint.frame, LEAST_MASS, name=name)
                ranges[f"{name}.mass"] = _LOAD * sum(masses)
                ranges[f"{name}.center"] = _CENTER
        constraints.append(constraint)
    # An effort that the file does not limit is taken for the largest one that it does.
    names = [signal.name for signal in model.links.position_signals]
    efforts = np.where(np.isfinite(model.control_limits), model.control_limits, 0.0)
    largest = float(np.max(efforts, initial=0.0)) or _EFFORT
    efforts = np.where(efforts > 0.0, efforts, largest)
    if efforts.size != len(names):
        efforts = np.full(len(names), largest)
    for joint, effort in zip(names, efforts.tolist(), strict=True):
        ranges[f"{joint}.coulomb"] = _COULOMB * effort
        ranges[f"{joint}.viscous"] = _VISCOUS * effort
    joints = [joint for joint in names if f"{joint}.coulomb" not in known]
    forces = [*robot.known_forces, *([JointFriction(joints)] if joints else [])]
    return replace(
        scenario,
        robot=replace(robot, payloads=[*robot.payloads, *loads.values()], known_forces=forces),
        constraints=constraints,
        estimator=replace(scenario.estimator, parameters=[*frictional, *ranges], ranges=ranges),
    )


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
    k: float,
    A: float,
    damping: float,
    force_gain: float,
    period: float,
    late: int,
) -> ScenarioTask:
    """The task whose touches do not open again.

    The law holds for each sample T the force

        u = lambda + K_i sum (lambda - F) T - c d' / A,    d'' = A (u - F),    F = k d,

    with the depth d, and the reference lambda that fades from the felt force to the goal. F is
    linear in the speed v of a touch, F = F_lambda(t) + v F_v(t), so that the largest v is the least
    F_lambda / -F_v of all times with F_v < 0. An Approach without a speed has this one, or its
    default if that is lower.
    """
    step = expm(period * np.array([[0.0, 1.0, 0.0], [-A * k, 0.0, A], [0.0, 0.0, 0.0]]))

    def force(depth: float, rate: float, reference: FloatArray) -> FloatArray:
        """F at each sample after a touch."""
        waiting, integral, forces = [k * depth] * late, 0.0, np.empty(reference.size)
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
    return replace(task, phases=phases)
