"""From a scenario to the closed loop that it describes."""

import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.dae import gains as designs
from drake_dae.dae import references
from drake_dae.dae.signals import Signal
from drake_dae.dae.structure import Structure, find_structure
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.diagrams import scenario as forms
from drake_dae.diagrams.closed_loop import ClosedLoop, make_closed_loop
from drake_dae.errors import AssumptionError, DrakeDaeError, InconsistentStateError, ScenarioError
from drake_dae.robots import actuation, outputs
from drake_dae.robots import contact as constraints
from drake_dae.robots.contact import surfaces
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.simulate import check_config, check_duration
from drake_dae.systems.robot_plant import RobotPlant
from drake_dae.systems.sensors import ForceSensor


def build_scenario(
    scenario: forms.Scenario, meshcat: Meshcat | None = None, live: bool = True
) -> tuple[ClosedLoop, Context]:
    """The closed loop of a scenario, and its context at the start.

    Args:
        scenario: As loaded.
        meshcat: Where to draw, or None.
        live: As in `make_closed_loop`.

    Raises:
        ScenarioError: What does not fit, with the key.
    """
    with _at("duration"):
        check_duration(scenario.duration)
    with _at("integrator"):
        check_config(scenario.integrator)
    scene_graph = SceneGraph()
    with _at("robot.file"):
        links = MultibodyExpressions(_parse(scenario.robot, scene_graph))
        if not links.actuator_signals:
            raise ScenarioError(
                f"'{Path(scenario.robot.file).name}' has no actuators; in a URDF, give each driven "
                "joint a <transmission>"
            )

    # What it touches or holds, what it shall do, and where.
    bound = _constraints(scenario.constraints, links)
    positions = _outputs(scenario.outputs, bound, links)
    with _at("start.positions"):
        guess = links.default_positions.copy()
        for name, value in scenario.start.positions.items():
            index = _index(name, links.position_signals, "joint position")
            low, high = (limits[index] for limits in links.position_limits)
            if not low <= value <= high:
                unit = links.position_signals[index].unit
                raise ScenarioError(
                    f"{name} = {value:g} {unit} is outside its limits, {low:g} to {high:g} {unit}"
                )
            guess[index] = value
    stages = []
    for index, form in enumerate(scenario.actuation):
        with _at(f"actuation.{index}"):
            stage = _stage(form)
            stage.attach(links)  # Now, while the index is known.
            stages.append(stage)
    with _at("actuation" if stages else "outputs"):
        name = Path(scenario.robot.file).name.split(".")[0]  # Of "two_arms.dmd.yaml", too.
        model = RobotModel(links, bound, positions, guess, name, stages)
    structure = _structure(model.dae)

    # The law and its references.
    measured = scenario.force if isinstance(scenario.force, forms.MeasuredForce) else None
    sensor = None
    if measured is not None:
        with _at("force"):
            sensor = _sensor(measured, model.dae.num_constraints)
    with _at("force or gains" if measured else "gains"):
        gain = _one_or_many(measured.gain) if measured else 0.0
        law = TrackingLaw(model.dae, _gains(scenario.gains), structure, measured is not None, gain)
    wanted = _references(scenario.references, law)
    with _at("force" if measured else "start.positions"):
        loop = make_closed_loop(
            RobotPlant(model, structure),
            law,
            wanted,
            sensor=sensor,
            scene_graph=scene_graph,
            meshcat=meshcat,
            live=live,
            start_time=scenario.integrator.start_time,
        )

    # At rest, where the references begin, plus the errors.
    context = loop.diagram.CreateDefaultContext()
    context.SetTime(scenario.integrator.start_time)
    plant_context = loop.plant.GetMyMutableContextFromRoot(context)
    with _at("plant_parameters"):
        for name, numbers in scenario.plant_parameters.items():
            loop.plant.set_parameter(plant_context, name, numbers)
    parameters = loop.plant.parameters(plant_context)
    q, forces = _start(scenario, model, loop, guess, parameters)
    with _at("start"):
        state = model.rest_state(q, forces, parameters)
        loop.plant.set_consistent_state(plant_context, state)
    if measured is not None and sensor is not None:
        sensor.set_force(sensor.GetMyMutableContextFromRoot(context), forces)
        loop.set_seed(context, measured.seed)
    return loop, context


def _parse(robot: forms.Robot, scene_graph: SceneGraph) -> MultibodyPlant:
    is_url = robot.file.startswith("package://")
    if not is_url and not Path(robot.file).is_file():
        raise ScenarioError(
            f"no file '{robot.file}'; a relative path starts in the scenario's folder"
        )
    # Continuous: only then are the plant's own dynamics those of (37).
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = Parser(plant)
    try:
        parser.package_map().AddPackageXml(str(forms.FOLDER / "models" / "package.xml"))
        for name, folder in robot.packages.items():
            parser.package_map().Add(name, folder)
        if is_url:
            parser.AddModelsFromUrl(robot.file)
        else:
            parser.AddModels(robot.file)
        plant.Finalize()
    except RuntimeError as error:
        raise ScenarioError(_line(error)) from None
    return plant


def _constraints(given: Sequence[typing.Any], links: Links) -> list[constraints.Constraint]:
    result: list[constraints.Constraint] = []
    for index, form in enumerate(given):
        with _at(f"constraints.{index}.name"):
            if not form.name or form.name in [other.name for other in given[:index]]:
                raise ScenarioError(f"each constraint needs a name of its own, got '{form.name}'")
        values = {item.name: getattr(form, item.name) for item in fields(form)}
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        if isinstance(form, forms.PointOnSurface):
            with _at(f"constraints.{index}.surface"):
                values["surface"] = _make(surfaces, form.surface)
        elif isinstance(form, forms.WeldedFrames):
            with _at(f"constraints.{index}.pose"):
                values["pose"] = _pose(form.pose)
        with _at(f"constraints.{index}"):
            constraint = getattr(constraints, type(form).__name__)(**values)
            constraint.residual(links)  # Now, while the index is known.
            result.append(constraint)
    return result


def _pose(form: forms.Pose) -> RigidTransform:
    for key, value in (("translation", form.translation), ("rpy_deg", form.rpy_deg)):
        if len(value) != 3:
            raise ScenarioError(f"{key}: 3 numbers are needed, got {value}")
    return RigidTransform(RollPitchYaw(np.deg2rad(form.rpy_deg)), form.translation)


def _outputs(
    given: Sequence[typing.Any], bound: Sequence[constraints.Constraint], links: Links
) -> list[outputs.PositionOutput]:
    contacts = [c for c in bound if isinstance(c, constraints.PointOnSurface)]
    result = []
    for index, form in enumerate(given):
        with _at(f"outputs.{index}"):
            output: outputs.PositionOutput
            if isinstance(form, forms.SurfaceCoordinates):
                contact = contacts[_index(form.constraint, contacts, "point on a surface")]
                output = outputs.SurfaceCoordinates(contact)
            else:
                output = _make(outputs, form)
            output.expression(links)  # Now, while the index is known.
            result.append(output)
    return result


def _stage(form: typing.Any) -> actuation.Stage:
    """A stage of actuation; what was left out is the robot's own."""
    values = {item.name: getattr(form, item.name) for item in fields(form)}
    for item in fields(form):
        if item.metadata.get("required") and not values[item.name].size:
            raise ScenarioError(f"{item.name}: empty; give one number, or one per actuator")
    numbers = {name: _one_or_many(value) for name, value in values.items() if value.size}
    return typing.cast(actuation.Stage, getattr(actuation, type(form).__name__)(**numbers))


def _sensor(form: forms.MeasuredForce, size: int) -> ForceSensor:
    if not 0 <= form.seed < 2**32:
        raise ScenarioError(f"seed: a whole number from 0 to 2^32 - 1 is needed, got {form.seed}")
    bias, noise = _one_or_many(form.bias), _one_or_many(form.noise_deviation)
    return ForceSensor(size, form.time_constant, form.sample_period, bias, noise)


def _one_or_many(value: FloatArray) -> float | FloatArray:
    """A list of one number is that number, which serves all."""
    return float(value.item()) if value.size == 1 else value


def _structure(dae: DaeSystem) -> Structure:
    """The structure of a system, or the key that spoils it."""
    try:
        return find_structure(dae)
    except InconsistentStateError as error:
        raise ScenarioError(f"constraints or start.positions: {_line(error)}") from error
    except AssumptionError as error:
        key = "constraints" if error.assumption <= 3 else "outputs"
        raise ScenarioError(f"{key}: {_line(error)}") from error


def _gains(form: typing.Any) -> designs.GainDesign:
    if isinstance(form, forms.Matrices):
        for group in form.groups:
            for matrix in group:
                if len({len(row) for row in matrix}) != 1:
                    raise ScenarioError(f"groups: the rows of {matrix} have different lengths")
        return designs.gain_matrices(*form.groups)
    if form.all and form.outputs:
        raise ScenarioError("give either 'all' or 'outputs', not both")
    design = designs.poles if isinstance(form, forms.Poles) else designs.gain_coefficients
    return design(form.all or form.outputs)


def _references(given: Sequence[typing.Any], law: TrackingLaw) -> list[typing.Any]:
    signals = law.system.output_signals
    result: list[typing.Any] = []
    first = 0
    names = {
        "Constant": "ConstantReference",
        "Sinusoids": "SinusoidReference",
        "PointToPoint": "PointToPointReference",
    }
    for index, form in enumerate(given):
        with _at(f"references.{index}"):
            if isinstance(form, forms.Sinusoids) and not form.phases:
                form = replace(form, phases=[0.0] * len(form.amplitudes))
            _check_lengths(form)
            values = {item.name: getattr(form, item.name) for item in fields(form)}
            reference = getattr(references, names[type(form).__name__])(**values)
            degrees = law.degrees[first : first + reference.size]
            if len(degrees) < reference.size:
                raise ScenarioError(
                    f"too many: {reference.size} values, but left without a reference: "
                    f"{_names(signals[first:])}"
                )
            reference.derivatives(degrees)  # Now, while the index is known.
            result.append(reference)
            first += reference.size
    if first < len(signals):
        raise ScenarioError(
            f"references: too few, left without one: {_names(signals[first:])}; needed, in this "
            f"order: {_names(signals)}"
        )
    return result


def _check_lengths(form: typing.Any) -> None:
    """Refuses lists that do not fit each other; NumPy would stretch some of them."""
    if isinstance(form, forms.Constant) and not form.values:
        raise ScenarioError("values: empty")
    if isinstance(form, forms.Sinusoids):
        lists = {key: getattr(form, key) for key in ("amplitudes", "frequencies", "phases")}
    elif isinstance(form, forms.PointToPoint):
        lists = {"start": form.start, "end": form.end}
    else:
        return
    lengths = {key: len(values) for key, values in lists.items()}
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        found = ", ".join(f"{key} has {length}" for key, length in lengths.items())
        raise ScenarioError(
            f"{', '.join(lists)} need as many entries as each other, at least one: {found}"
        )


def _start(
    scenario: forms.Scenario,
    model: RobotModel,
    loop: ClosedLoop,
    guess: FloatArray,
    parameters: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """q and lambda where the outputs have their references plus the start errors."""
    signals = model.dae.output_signals
    degrees = loop.controller.law.degrees
    reference = loop.reference.reference(scenario.integrator.start_time)
    starts = np.cumsum([0, *[degree + 1 for degree in degrees]])
    wanted = reference[starts[:-1]]
    with _at("start.errors"):
        for name, error in scenario.start.errors.items():
            index = _index(name, signals, "output")
            if degrees[index] == 0:
                raise ScenarioError(
                    f"'{name}' has degree 0: the law meets it at once and it has no start error"
                )
            wanted[index] += error
    signals = model.position_signals
    wanted, forces = np.split(wanted, [len(signals)])
    try:
        return model.configuration(wanted, guess, parameters), forces
    except InconsistentStateError as error:
        goal = ", ".join(
            f"{signal.name} = {value:.4g} {signal.unit}".rstrip()
            for signal, value in zip(signals, wanted, strict=True)
        )
        raise ScenarioError(
            f"start: found no configuration near start.positions with {goal} (the references and "
            f"start.errors at the start) on the constraints: {_line(error)}"
        ) from error


def _make(module: typing.Any, form: typing.Any) -> typing.Any:
    """The object that a form describes: the class or function of that name in a module."""
    name = type(form).__name__
    snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")
    target = getattr(module, name, None) or getattr(module, snake)
    return target(**{item.name: getattr(form, item.name) for item in fields(form)})


def _index(name: str, named: Sequence[typing.Any], kind: str) -> int:
    """Where a name stands among things with names."""
    names = [item.name for item in named]
    if name in names:
        return names.index(name)
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise ScenarioError(f"no {kind} '{name}'; {hint}there are {', '.join(names) or 'none'}")


def _names(signals: Sequence[Signal]) -> str:
    return ", ".join(signal.name for signal in signals) or "none"


def _line(error: Exception) -> str:
    """A message in one line."""
    return " ".join(str(error).split())


@contextmanager
def _at(key: str) -> Iterator[None]:
    """Puts the key of the scenario before whatever goes wrong."""
    try:
        yield
    except DrakeDaeError as error:
        raise ScenarioError(f"{key}: {_line(error)}") from error
