"""Every public name, called with what makes no sense: only errors of errors.py come out.

The calls are found by signatures. A public name that is new is called as well: with the values that
SAMPLES has for the types of its arguments, or PLACES for their names; where there is none, the
tests of that name fail and say so.
"""

import contextlib
import datetime
import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import casadi as ca
import numpy as np
import pytest
from arms import arm, fixed_step, law
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from polishing import laws, soft_wall, task_loop
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame
from pydrake.symbolic import Variable
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, System
from pydrake.trajectories import PiecewisePolynomial, Trajectory

import drake_dae as dd
from drake_dae.analysis.findings import Assumption
from drake_dae.dae.derivatives import Derivatives
from drake_dae.dae.elimination import Elimination
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.states.margins import RankMargin
from drake_dae.dae.zero_dynamics.pinned.pinned_motion import PinnedMotion
from drake_dae.errors import DrakeDaeError, SimulationError
from drake_dae.pictures.scene.run_motion import ShownLoop
from drake_dae.robots.actuation.stage import Stage
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.tree_kinematics import TreeKinematics
from drake_dae.robots.outputs import PositionOutput
from drake_dae.robots.surfaces.surface import Surface
from drake_dae.running.rollout.rollout import Rollout
from drake_dae.scenario.plants import RobotToSimulate
from drake_dae.scenario.robot_file.links import add_robot
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.simulation.records.record import Recorded
from drake_dae.studies.runs import Outcome, RunResult
from drake_dae.systems.task.phases import Phase
from drake_dae.trace.functions import TracedFunction

FOLDER = Path(__file__).parent / "made"


@cache
def loop() -> dd.ClosedLoop:
    tracking = law("two_link")
    references = [dd.ConstantReference(0.3), dd.ConstantReference(10.0)]
    plant = dd.RobotPlant(arm("two_link").model, structure=arm("two_link").structure)
    return dd.make_closed_loop(plant, tracking, references)


def add_arm(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    robot = scenario().robot
    add_robot(robot, plant, scene_graph)


@cache
def contact_plant() -> dd.ContactPlant:
    found = arm("two_link")
    return dd.ContactPlant(found.model, add_arm, dd.ContactMaterial(), structure=found.structure)


@cache
def observed_law() -> dd.TrackingLaw:
    dae = dd.with_disturbance(arm("two_link").model.dae, ["joint1_w", "joint2_w"])
    return dd.TrackingLaw(dae, dd.poles(-4.0))


@cache
def observer() -> dd.DisturbanceObserver:
    return dd.DisturbanceObserver(observed_law(), dd.Observing(10.0), 0.01)


@cache
def estimator() -> dd.StateEstimator:
    return dd.StateEstimator(observed_law(), dd.Observing(10.0, state_rate=40.0), 0.01)


def sensed() -> dd.SensedContact:
    noise = dd.SensorNoise(1e-5, force=0.1)
    return dd.SensedContact(1e-3, 1, 1e5, 0.03, 0.3, 0.7, 0.7, 5.0, noise, True)


@cache
def record() -> dd.Record:
    context = loop().diagram.CreateDefaultContext()
    dd.simulate(loop().diagram, context, 0.01, fixed_step())
    return loop().record(context)


@cache
def task() -> dd.ClosedLoop:
    return task_loop([dd.Approach(), dd.Press(20.0)])


def context_of(owner: Any) -> Context:
    return (owner if isinstance(owner, System) else loop().diagram).CreateDefaultContext()


def state() -> np.ndarray:
    return arm("two_link").structure.states[0]


def normal_form() -> dd.NormalForm:
    return _normal_form()


@cache
def _normal_form() -> dd.NormalForm:
    return dd.NormalForm(arm("two_link").model.dae, structure=arm("two_link").structure)


@cache
def analysis() -> dd.Analysis:
    return dd.analyze(arm("two_link").model.dae, count=3)


@cache
def pinned_motion() -> PinnedMotion:
    dynamics = dd.ZeroDynamics(arm("two_link").model.dae, structure=arm("two_link").structure)
    return dynamics.motion(lambda t: record()["reference"][0], [0.0, 0.1])


@cache
def textbook() -> dd.LinkExpressions:
    q, v = ca.SX.sym("q"), ca.SX.sym("v")
    return dd.LinkExpressions(q, v, ca.SX(2.0), ca.SX(0.0), {"tool": ca.vertcat(q, 0, 0)})


@cache
def rolled() -> Rollout:
    start, parameters = dd.start_values(loop(), context_of(None))
    (found,) = dd.rollout(loop(), start, parameters, [0.0, 0.01], config=fixed_step())
    return found


@cache
def scenario() -> Scenario:
    return dd.load_scenario(find_scenario("two_link_wall"))


# A value of each type that is fine where nothing else is said.
SAMPLES: dict[Any, Callable[[], Any]] = {
    SimulationError: lambda: SimulationError("ended", 0.0, np.zeros(4)),
    TracedFunction: lambda: TracedFunction("one", {"x": ca.SX.sym("x")}, {"y": ca.SX(1)}),
    Rollout: rolled,
    Any: lambda: 1.0,
    ArrayLike: lambda: 1.0,
    bool: lambda: False,
    complex: lambda: -1.0,
    float: lambda: 0.5,
    int: lambda: 1,
    str: lambda: "tool",
    Path: lambda: find_scenario("two_link_wall"),
    ca.SX: lambda: ca.SX.sym("p", 3),
    Assumption: lambda: SAMPLES[dd.Analysis]().assumptions[0],
    Diagram: lambda: loop().diagram,
    dd.Analysis: analysis,
    dd.ClosedLoop: loop,
    dd.ContactMaterial: dd.ContactMaterial,
    dd.PointMaterial: dd.PointMaterial,
    dd.ContactPlant: contact_plant,
    dd.Controller: lambda: loop().controller,
    dd.LoopSettings: dd.LoopSettings,
    dd.Plant: lambda: loop().plant,
    dd.DaePlant: lambda: loop().plant,
    dd.DaeSystem: lambda: arm("two_link").model.dae,
    dd.Extension: lambda: dd.Extension(
        arm("two_link").model.dae,
        arm("two_link").model.dae,
        arm("two_link").structure,
        {},
        ca.SX(2, 1),
        ca.SX.eye(2),
    ),
    dd.FeedbackGains: lambda: law("two_link").gains,
    dd.ForceSensor: lambda: dd.ForceSensor(1, 0.1),
    dd.Sampling: lambda: dd.Sampling(0.01),
    dd.CommandedReferences: lambda: dd.CommandedReferences(
        [dd.ConstantReference(0.5)], [2], [dd.Signal("a")]
    ),
    dd.Encoders: lambda: dd.Encoders(1e-5),
    dd.Observing: lambda: dd.Observing(10.0),
    dd.DisturbanceObserver: observer,
    dd.StateEstimator: estimator,
    dd.SensedContact: sensed,
    "end": lambda: 0.5,
    dd.SensorNoise: lambda: dd.SensorNoise(),
    dd.AdvisedGains: lambda: dd.advised_gains(sensed(), 1.0),
    dd.LinkExpressions: textbook,
    dd.NormalForm: normal_form,
    Manifold: lambda: arm("two_link").structure.manifold,
    Derivatives: lambda: arm("two_link").structure.derivatives,
    Elimination: lambda: arm("two_link").structure.elimination,
    RankMargin: lambda: arm("two_link").structure.control_margin,
    PinnedMotion: pinned_motion,
    dd.PathLimits: lambda: dd.PathLimits(0.2, 1.0),
    dd.Record: record,
    dd.Reference: lambda: dd.ConstantReference(0.5),
    dd.ReferenceGenerator: lambda: loop().reference,
    dd.RobotModel: lambda: arm("two_link").model,
    dd.Signal: lambda: dd.Signal("a"),
    dd.ConstraintStructure: lambda: arm("two_link").structure,
    dd.Structure: lambda: arm("two_link").structure,
    dd.Task: lambda: dd.Task([dd.Approach(), dd.Press(20.0)]),
    dd.TaskController: lambda: task().controller,
    dd.TrackingController: lambda: loop().controller,
    dd.WaypointsReference: lambda: dd.WaypointsReference([[0.0], [1.0]], [0.0, 1.0]),
    dd.TrackingLaw: lambda: law("two_link"),
    Constraint: lambda: arm("two_link").model.constraints[0],
    Context: lambda: context_of(None),
    Frame: lambda: arm("two_link").plant.GetFrameByName("tool"),
    Frames: lambda: arm("two_link").model.links,
    Kinematics: lambda: arm("two_link").model.links.kinematics(),
    TreeKinematics: lambda: arm("two_link").model.links.kinematics(),
    Links: lambda: arm("two_link").model.links,
    MultibodyPlant: lambda: arm("two_link").plant,
    RobotToSimulate: lambda: RobotToSimulate(
        arm("two_link").model, arm("two_link").structure, False, "", add_arm, {}, ()
    ),
    PositionOutput: lambda: arm("two_link").model.outputs[0],
    Reaction: lambda: Reaction(ca.SX(2, 1)),
    Recorded: lambda: Recorded(np.zeros((2, 1)), (dd.Signal("a"),)),
    RigidTransform: RigidTransform,
    RunResult: lambda: RunResult(Outcome.FINISHED, figures={"steps": 1.0}),
    SceneGraph: SceneGraph,
    Scenario: scenario,
    SimulatorConfig: fixed_step,
    Stage: lambda: dd.DcMotors(0.1, 1e-3, 0.5),
    Surface: lambda: dd.Plane((0, 0, 0), (0, 0, 1)),
    System: lambda: loop().diagram,
    Trajectory: lambda: PiecewisePolynomial.CubicHermite([0, 1], [[0, 1]], [[0, 0]]),
    Variable: lambda: Variable("x"),
    ShownLoop: loop,
}

# What fits an argument with a name, of all names or of one.
PLACES: dict[str, Callable[[], Any]] = {
    "state": state,
    "states": lambda: state()[None],
    "nominal_state": state,
    "guess": state,
    "times": lambda: [0.0, 0.1],
    "times of sampling_error": lambda: [0.0, 0.1, 0.2],
    "states of sampling_error": lambda: np.tile(state(), (3, 1)),
    "controls of sampling_error": lambda: np.zeros((3, 2)),
    "reference": lambda: record()["reference"][0],
    "coordinates": lambda: normal_form().coordinates(state()),
    "parameters": lambda: arm("two_link").model.dae.parameter_values,
    "add_robot": lambda: add_arm,
    "parameters of ContactPlant": lambda: {"wall.position": [1.2, 0.0, 0.0]},
    "limits of ControlLimits": lambda: [1.0],
    "driver": lambda: "iiwa",
    "axes": lambda: "xz",
    "axis": lambda: (0.0, 0.0, 1.0),
    "axis of AxisCoordinates": lambda: "z",
    "axis of PrismaticLoopJoint": lambda: "x",
    "axis of RevoluteLoopJoint": lambda: "x",
    "major_radius": lambda: 2.0,
    "size": lambda: 1,
    "force of DisturbanceForce": lambda: (0.0, 0.0, 5.0),
    "size of StateSensor": lambda: 4,
    "n": lambda: 1,
    "components": lambda: "xy",
    "duration": lambda: 0.01,
    "max_integrators": lambda: 2,
    "law of DisturbanceObserver": observed_law,
    "law of StateEstimator": observed_law,
    "gains of AdvisedGains": lambda: dd.contact_gains(1e5, 0.03, 1e-3),
    "observing of StateEstimator": lambda: dd.Observing(10.0, state_rate=40.0),
    "states of with_disturbance": lambda: ["joint1_w", "joint2_w"],
    "region": lambda: None,
    "measured_force": lambda: None,
    "settings": lambda: (),
    "settings of make_closed_loop": lambda: None,
    "settings of wire_loop": lambda: None,
    "constraint_force": lambda: ca.SX.sym("lambda", 1),
    "constraint_force of CoincidentPoints.reaction": lambda: ca.SX.sym("lambda", 2),
    "constraint_force of WeldedFrames.reaction": lambda: ca.SX.sym("lambda", 6),
    "center": lambda: (0.0, 0.0, 0.0),
    "degrees": lambda: [2],
    "outputs": lambda: [0.3, 10.0],
    "host": lambda: "localhost",
    "seed": lambda: 0,
    "plant of make_closed_loop": lambda: dd.RobotPlant(
        arm("two_link").model, structure=arm("two_link").structure
    ),
    "phases": lambda: [dd.Approach()],
    "references of Move": lambda: {"tool.z": 0.3},
    "force of Press": lambda: 20.0,
    "of": lambda: "force",
    "outputs of Search": lambda: "tool.yz",
    "task": lambda: dd.Task([dd.Approach()]),
    "law of TaskController": lambda: laws()[0],
    "free_law": lambda: laws()[1],
    "force of open_contact": lambda: "wall.force",
    "system of open_contact": lambda: arm("two_link").model.dae,
    "outputs of TaskController.rest_state": lambda: [0.3, 0.02],
    "name of TaskController.set_parameter": lambda: "wall.position",
    "value of TaskController.set_parameter": lambda: [1.2, 0.0, 0.0],
    "plant of wire_loop": lambda: soft_wall(),
    "controller of wire_loop": lambda: dd.TaskController(
        dd.Task([dd.Approach()]), laws()[0], laws()[1], sample_period=1e-3
    ),
    "integrators": lambda: {"joint1_motor": 1},
    "nominal_control": lambda: None,
    "spread": lambda: None,
    "count": lambda: 3,
    "structure": lambda: arm("two_link").structure,
    "structure of Analysis": lambda: None,
    "actuation": lambda: (),
    "name": lambda: "name",
    "time": lambda: ca.SX.sym("t"),
    "values": lambda: -1.0,
    "values of gain_coefficients": lambda: [4.0, 4.0],
    "name of DaePlant.get_parameter": lambda: "link1.mass",
    "name of DaePlant.set_parameter": lambda: "link1.mass",
    "name of RobotPlant.get_parameter": lambda: "link1.mass",
    "name of RobotPlant.set_parameter": lambda: "link1.mass",
    "name of StateRealization.get_parameter": lambda: "link1.mass",
    "name of StateRealization.set_parameter": lambda: "link1.mass",
    "name of TrackingController.get_parameter": lambda: "link1.mass",
    "name of TrackingController.set_parameter": lambda: "link1.mass",
    "name of DaeSystem.parameter_slice": lambda: "link1.mass",
    "state of DaeSystem": lambda: ca.SX.sym("x", 1),
    "state of DaeSystem.from_functions": lambda: ["x"],
    "state of from_symbolic": lambda: [Variable("x")],
    "f of from_symbolic": lambda: [1.0],
    "h of from_symbolic": lambda: [1.0],
    "outputs of ExpressionOutput": lambda: [dd.Signal("a")],
    "outputs of RobotModel.configuration": lambda: [0.3],
    "guess of RobotModel.configuration": lambda: [1.2, -1.6],
    "positions of RobotModel.rest_state": lambda: [1.2, -1.6],
    "positions of RobotModel.rest_forces": lambda: [1.2, -1.6],
    "second": lambda: "other",
    "forces": lambda: [1.0],
    "forces of RobotModel": lambda: None,
    "forces of RobotModel.from_multibody": lambda: None,
    "follower": lambda: "joint1",
    "matrix": lambda: [[4.0, 4.0]],
    "times of FeedbackGains.error_response": lambda: [0.0, 0.1],
    "initial": lambda: [1.0, 1.0],
    "end_time": lambda: 1.0,
    "control": lambda: [1.0, 1.0],
    "reference of ZeroDynamics.motion": lambda: lambda t: record()["reference"][0],
    "reference of ZeroDynamics.stability_along": lambda: lambda t: record()["reference"][0],
    "guesses": lambda: state()[None],
    "reference of analyze": lambda: None,
    "times of analyze": lambda: None,
    "time of Record": lambda: [0.0, 1.0],
    "time of ReferenceGenerator.reference": lambda: 0.0,
    "references": lambda: [dd.ConstantReference([0.3, 10.0])],
    "references of ReferenceGenerator": lambda: [dd.ConstantReference(0.3)],
    "references of references_by_name": lambda: {"a": 0.3},
    "rows of ReferenceRows": lambda: (0,),
    "limits of CircleReference": lambda: None,
    "center of SpiralReference": lambda: [0.0, 0.0],
    "points of PolylineReference": lambda: [[0.0], [1.0]],
    "points of WaypointsReference": lambda: [[0.0], [1.0]],
    "times of WaypointsReference": lambda: [0.0, 1.0],
    "limits of WaypointsReference": lambda: None,
    "order of WaypointsReference": lambda: 2,
    "file of CsvReference": lambda: str(
        Path(__file__).parent / "systems" / "control" / "steps.csv"
    ),
    "columns of CsvReference": lambda: ["x"],
    "outputs of references_by_name": lambda: ["a"],
    "degrees of references_by_name": lambda: [1],
    "q": lambda: ca.SX.sym("q"),
    "v": lambda: ca.SX.sym("v"),
    "mass_matrix": lambda: ca.SX(2.0),
    "bias": lambda: ca.SX(0.0),
    "path": lambda: find_scenario("two_link_wall"),
    "values of grid_variations": lambda: {"duration": [1.0, 2.0]},
    "values of listed_variations": lambda: {"duration": [1.0, 2.0]},
    "size of MeasuredSurface": lambda: (0.4, 0.3),
    "heights": lambda: [[0.0, 0.1], [0.0, 0.2]],
    "file": lambda: None,
    "ranges": lambda: {"duration": (1.0, 2.0)},
    "variations of Study": lambda: ({"duration": 1.0},),
    "figure": lambda: "steps",
    "log": lambda: loop().log,
    "signals of Record.from_log": lambda: loop().logged,
    "groups": lambda: [np.eye(1), np.eye(1)],
    "starts": state,
    "parameters of rollout": lambda: None,
}

# What makes no sense for most arguments. Nothing is large: a long run that is asked for is none.
NONSENSE: tuple[Any, ...] = (
    None,
    "",
    "text",
    "a\0b",
    "$x^$",
    b"bytes",
    True,
    -1,
    0,
    2.5,
    1j,
    10**400,
    float("nan"),
    float("inf"),
    -float("inf"),
    [],
    [[]],
    {},
    {"a": 1.0},
    {1: "a"},
    ["a"],
    [None],
    [float("nan")],
    [1.0, "a"],
    [[1.0], [1.0, 2.0]],
    [[[1.0]]],
    (0.0, 0.0),
    (0.0, 0.0, 0.0),
    {1.0},
    range(3),
    object(),
    int,
    lambda *given: None,
    lambda *given: "a",
    lambda: 1.0,
    np.zeros(3),
    np.zeros((1, 4)),
    np.full(4, np.nan),
    np.full((2, 2), np.inf),
    np.array(["a"]),
    np.array(None),
    np.array([1.0, None]),
    np.ma.masked_array([1.0, 2.0], [True, False]),
    np.datetime64("2020-01-01"),
    datetime.date(2020, 1, 1),
    ca.SX.sym("a"),
    ca.SX.sym("a", 2, 2),
    ca.MX.sym("a"),
    ca.DM([1.0, 2.0]),
    dd.Signal("a"),
    dd.Parameter("a", 1.0),
    dd.ConstantReference(1.0),
    Path("nowhere"),
)


class Call(NamedTuple):
    """A public function, a constructor, or a method of what SAMPLES has."""

    label: str
    function: Callable[..., Any]
    annotations: dict[str, Any]
    owner: Any = None


def public() -> Iterator[tuple[str, Any]]:
    for name in dd.__all__:
        member = getattr(dd, name)
        if callable(member) and not (
            inspect.isclass(member) and issubclass(member, (Exception, Warning, Enum))
        ):
            yield name, member


# What the library calls on its members, with arguments of its own: rules for who writes one.
CONTRACTS = (Surface, Constraint, PositionOutput, dd.ForceOutput, Stage, dd.Reference, Phase)

# And what it calls on plants and controllers, whose other rules are for everybody.
CALLED = {"add_own_view", "check_plant", "derived", "motion_under", "predicted_error", "robot"}


def methods(cls: type) -> set[str]:
    """Public methods of ours; those of Drake begin with a capital, or are its own.

    Not those of a contract, nor those that build expressions, as of `Kinematics`.
    """
    return {
        name
        for base in cls.__mro__
        if base.__module__.startswith("drake_dae")
        for name, member in vars(base).items()
        if name[0].islower()
        and not (name in CALLED and issubclass(cls, dd.Plant | dd.Controller))
        and (inspect.isfunction(member) or isinstance(member, (classmethod, staticmethod)))
        and not any(hasattr(contract, name) for contract in CONTRACTS if issubclass(cls, contract))
        and "casadi" not in str(inspect.signature(getattr(cls, name)))
    }


def labels() -> Iterator[str]:
    for name, member in public():
        if not inspect.isabstract(member):
            yield name
        if inspect.isclass(member):
            yield from (f"{name}.{method}" for method in sorted(methods(member)))


def call(label: str) -> Call:
    name, _, method = label.partition(".")
    member = getattr(dd, name)
    if not method:
        function = member.__init__ if inspect.isclass(member) else member
        return Call(label, member, get_type_hints(function))
    known = [of for of in (member, *member.__mro__) if of in SAMPLES]
    owner = SAMPLES[known[0]]() if known and known[0] is member else made(name)
    function = getattr(owner, method)
    return Call(label, function, get_type_hints(inspect.unwrap(function)), owner)


@cache
def made(name: str) -> Any:
    """One of a public class."""
    cls = call(name)
    return cls.function(**valid(cls))


def valid(of: Call) -> dict[str, Any]:
    """Arguments that fit; those with a default are left out."""
    found = {}
    for name, parameter in parameters(of).items():
        if parameter.default is parameter.empty:
            found[name] = sample(of, name)
    return found


def parameters(of: Call) -> dict[str, inspect.Parameter]:
    every = inspect.signature(of.function).parameters
    return {n: p for n, p in every.items() if p.kind is not p.VAR_KEYWORD}


def sample(of: Call, name: str) -> Any:
    for place in (f"{name} of {of.label}", name):
        if place in PLACES:
            return PLACES[place]()
    hint = of.annotations.get(name, Any)
    if hint is Context:
        return context_of(of.owner)
    return sample_of(hint, f"{of.label}: {name}")


def sample_of(hint: Any, what: str) -> Any:
    if hint in SAMPLES:
        return SAMPLES[hint]()
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        known = [a for a in arguments if a in SAMPLES]
        if NoneType in arguments and not known:
            return None
        return sample_of((known or arguments)[0], what)
    if origin is np.ndarray or origin is NDArray:  # The latter from NumPy 2.5 on.
        return np.ones(1)
    if origin is tuple and arguments[1:] != (...,):
        return tuple(sample_of(argument, what) for argument in arguments)
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return {sample_of(arguments[0], what): sample_of(arguments[1], what)}
    if inspect.isclass(origin) and issubclass(origin, (Sequence, tuple)):
        return [sample_of(arguments[0], what)]
    if origin is not None and callable(hint):
        return lambda *given: 1.0
    pytest.fail(f"{what} is a {hint}, and SAMPLES has none: add one, so that it is tested too")


def invoke(of: Call, arguments: dict[str, Any]) -> None:
    """Calls by position what can only be given so."""
    positional = []
    for name, parameter in parameters(of).items():
        if parameter.kind is parameter.VAR_POSITIONAL and name in arguments:
            given_list = arguments.pop(name)
            positional += given_list if isinstance(given_list, list) else [given_list]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        of.function(*positional, **arguments)


# By its place: CasADi and NumPy have no == and no hash, as Hypothesis would like.
WRONG = st.one_of(
    st.integers(0, len(NONSENSE) - 1).map(NONSENSE.__getitem__),
    st.floats(-100.0, 100.0),
    st.lists(st.floats(-2.0, 2.0), max_size=5),
    st.text(max_size=5),
)
EXAMPLES = 8
"""Of each name in a run of the tests; all of them, one argument at a time, are 20,000 calls."""

EVERY = tuple(labels())
# What a call does apart from its arguments is not wanted here.
SIDE_EFFECTS = {
    "start_meshcat": "it opens a port",
    "Record.save": "it writes to the given path",
    "write_page": "it writes to the given path",
    "export_code": "it writes to the given path",
    "sweep": "it writes to the given path",
    "Study.save": "it writes to the given path",
}


@pytest.mark.slow
@pytest.mark.parametrize("label", [label for label in EVERY if label not in SIDE_EFFECTS])
def test_wrong_arguments_end_as_errors_of_the_library(label, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    of = call(label)

    @settings(
        derandomize=True,
        database=None,
        deadline=None,
        max_examples=EXAMPLES,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def every(data: st.DataObject) -> None:
        wrong = data.draw(st.lists(st.sampled_from(list(parameters(of))), min_size=1, max_size=2))
        arguments = valid(of)
        for name in wrong:
            arguments[name] = data.draw(WRONG)
        with contextlib.suppress(DrakeDaeError):
            invoke(of, arguments)

    if parameters(of):
        every()
