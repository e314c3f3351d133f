"""The gains and the estimator that a scenario with contact that gives way leaves out."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from drake_dae.dae import AdvisedGains, Structure, advised_gains, contact_gains
from drake_dae.dae.advised_gains import settles_along
from drake_dae.errors import GainError, ScenarioError
from drake_dae.robots import JointFriction, Plane, PointOnSurface, RobotModel, velocities_are_rates
from drake_dae.scenario import parts as parts
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.expected import (
    PATCH_FORCE,
    expected,
    jam,
    least_damping,
    moved_points,
    rounded,
    sensed_contact,
    stated_errors,
    timing,
    with_lasting_touches,
)
from drake_dae.scenario.form import at
from drake_dae.scenario.model import references_of
from drake_dae.scenario.robot_file.robot import Payload
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import opening_contact

_SOFTER = 5.0
"""The ratio of the poles of positions to those of the distance, of a robot without contact."""

NOISE = 1e-3
"""The standard deviation of velocity noise in rad/s, without encoders."""

_SHARE = 0.003
"""The default of the largest roughness, as a fraction of the largest effort limit."""


LEAST_MASS = 1e-6
"""The mass in kg of a load that nobody has stated; masses are positive."""

_LOAD, _TILT, _COULOMB, _VISCOUS = 0.2, 0.15, 0.1, 0.25
"""The largest load relative to the robot's mass, the largest tilt in rad, and the largest friction
of a joint in N m, and in N m per rad/s, relative to its largest effort."""

_PLACE = 0.01
"""The largest displacement of a plane in m."""

_CENTER = 0.2
"""The largest distance of a load from its frame's origin, in m."""

_EFFORT = 100.0
"""The largest effort in N m of drives without limits in the file."""


def advised(scenario: Scenario, model: RobotModel, structure: Structure) -> Completed:
    """The gains and other settings that a scenario on contact that gives way leaves out.

    These are gains, integrals of forces and of points, constraint damping, an estimator, and
    measured force, each if it is left out; and for a task the gains without contact, soft along the
    distance. With encoders and rigid joints the gains are those of `advised_gains`; otherwise those
    of `contact_gains`. A scenario with `law.gains`, or with ideal contact, is unchanged.

    Raises:
        ScenarioError: There are no default gains for such a scenario, or none are smooth and stable
            enough; or `largest_roughness` or `largest_errors` is given and not used.
    """
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
    task, touch_note = scenario.task, ""
    if task is not None:
        if task.gains is None:
            free = {signal.name: contact.position_gains(2) for signal in model.position_signals}
            rate = contact.position_rate / _SOFTER
            for point in opening_contact(scenario, model):
                free[point.residual_signals[0].name] = [rate**2, 2.0 * rate]
            task = replace(task, gains=_coefficients(free))
        acting = least_damping(structure, damping), contact.force_gain, period, period * (1 + late)
        task, touch_note = with_lasting_touches(task, stiffness, mobility, *acting)
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
        identified = "friction, loads, tilts and places of planes"
        if scenario.compliances is not None:
            identified = "friction and loads"
    shape = "Butterworth's" if contact.position_damping < 0.75 else "equal"
    estimated = "" if fast is None else f", and an estimate of the state of {rounded(fast):g} 1/s"
    note = (
        f"recommended for a contact of {stiffness:.2g} N/m and {mobility:.2g} 1/kg, samples of "
        f"{period:g} s and {known_by}: {shape} poles of positions "
        f"at {rounded(contact.position_rate):g} 1/s, and of forces one at "
        f"{-rounded(contact.force_gain):g} 1/s, with integrals of {', '.join(integral)}, damping "
        f"of the constraint {rounded(contact.constraint_damping):g} 1/s, an estimator of "
        f"{estimator.rate:g} 1/s that identifies: {identified}{estimated}"
        f"{outlook}{f'. {expected(chosen, stated)}' if stated else ''}{touch_note}"
    )
    told = note, jam(scenario, model, structure, material.friction)
    return Completed(chosen, tuple(filter(None, told)))


def _coefficients(gains: Mapping[str, Sequence[float]]) -> parts.Coefficients:
    return parts.Coefficients(outputs={n: [*map(rounded, own)] for n, own in gains.items()})


def _sensed_gains(
    scenario: Scenario, model: RobotModel, structure: Structure, stiffness: float
) -> tuple[AdvisedGains, str]:
    """The gains for a contact and encoders, and what is predicted for them, in words."""
    law = scenario.law
    sensed = sensed_contact(scenario, model, structure, stiffness)
    roughness = law.largest_roughness
    if roughness is None:
        efforts = model.control_limits[np.isfinite(model.control_limits)]
        roughness = _SHARE * float(np.max(efforts)) if efforts.size else 1.0
    bounds = {} if law.largest_errors is None else vars(law.largest_errors)
    errors = {f"{name}_error": most for name, most in bounds.items() if most is not None}
    bare = ""
    try:
        best = advised_gains(sensed, roughness, **errors)
    except GainError:
        # Gains of a contact of half the stiffness are stable up to twice that.
        softer = replace(sensed, stiffness=stiffness / 2.0)
        if settles_along(sensed) or not settles_along(softer):
            raise
        best = advised_gains(softer, roughness, **errors)
        bare = ". A contact that is stiffer than stated may be unstable: sample more often"
    return best, (
        ". These gains are the best for one direction alone, "
        f"{1e3 * best.noise_error:.2g} mm and {best.noise_force:.2g} N rms by noise, and a change "
        f"of the controls of {best.roughness:.2g} N m from sample to sample{bare}"
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


def with_friction_estimated(scenario: Scenario, model: RobotModel) -> Scenario:
    """The scenario of a law whose estimator knows the friction of contacts that have it."""
    assert scenario.estimator is not None
    names = [c.friction_parameter for c in model.constraints if c.friction_parameter]
    return replace(scenario, estimator=replace(scenario.estimator, parameters=names))


def with_all_estimated(scenario: Scenario, model: RobotModel) -> Scenario:
    """The scenario of a law whose estimator knows loads, places of planes, and friction.

    A load is at each frame in contact, a mass and its place; the friction is that of contacts, and
    Coulomb and viscous friction of all driven joints. Their bounds, from which their estimation
    starts, follow from masses and efforts of the robot's file.
    """
    assert scenario.estimator is not None
    robot, frictional = scenario.robot, list[str]()
    ranges: dict[str, float] = {}
    loads: dict[str, Payload] = {}
    known = {p.name for p in model.dae.parameters}
    masses = [p.value[0] for p in model.dae.parameters if p.name.endswith(".mass")]
    constraints = []
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
    names_of_joints = [signal.name for signal in model.links.position_signals]
    efforts = np.where(np.isfinite(model.control_limits), model.control_limits, 0.0)
    largest = float(np.max(efforts, initial=0.0)) or _EFFORT
    efforts = np.where(efforts > 0.0, efforts, largest)
    if efforts.size != len(names_of_joints):
        efforts = np.full(len(names_of_joints), largest)
    joints = [joint for joint in names_of_joints if f"{joint}.coulomb" not in known]
    for joint, effort in zip(names_of_joints, efforts.tolist(), strict=True):
        ranges[f"{joint}.coulomb"] = _COULOMB * effort
        ranges[f"{joint}.viscous"] = _VISCOUS * effort
    forces = [*robot.known_forces, *([JointFriction(joints)] if joints else [])]
    return replace(
        scenario,
        robot=replace(robot, payloads=[*robot.payloads, *loads.values()], known_forces=forces),
        constraints=constraints,
        estimator=replace(scenario.estimator, parameters=[*frictional, *ranges], ranges=ranges),
    )
