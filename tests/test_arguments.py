"""Every public name, called with what makes no sense: only errors of errors.py come out.

Functions and constructors are found by their signatures. One that is new is called as well: with
the values that SAMPLES has for the types of its arguments, or PLACES for their names; where there
is none, the test of that name fails and says so.
"""

import contextlib
import gc
import inspect
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import casadi as ca
import numpy as np
import pytest
from arms import arm, fixed_step, law
from numpy.typing import ArrayLike, NDArray
from polishing import laws, task_loop
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Variable
from pydrake.systems.framework import Context, Diagram, System
from pydrake.trajectories import PiecewisePolynomial, Trajectory

import drake_dae as dd
from drake_dae.analysis import Analysis, Assumption
from drake_dae.arguments import checked, uncollected
from drake_dae.blocks.block import Block
from drake_dae.dae import (
    Derivatives,
    Elimination,
    FeedbackGains,
    Manifold,
    PinnedMotion,
    RankMargin,
    SensedContact,
    SensorNoise,
    with_disturbance,
)
from drake_dae.diagrams.record import Recorded
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.references import PathLimits
from drake_dae.robots import Constraint, Links, Surface
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.systems import Controller, Observing, Plant, PointMaterial


@cache
def loop() -> dd.ClosedLoop:
    tracking = law("two_link")
    references = [dd.ConstantReference(0.3), dd.ConstantReference(10.0)]
    plant = dd.RobotPlant(arm("two_link").model, structure=arm("two_link").structure)
    return dd.make_closed_loop(plant, tracking, references)


def add_arm(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    robot = scenario().robot
    read_robot(robot, plant, scene_graph)


@cache
def observed_law() -> dd.TrackingLaw:
    dae = with_disturbance(arm("two_link").model.dae, ["joint1_w", "joint2_w"])
    return dd.TrackingLaw(dae, dd.poles(-4.0))


def sensed() -> SensedContact:
    noise = SensorNoise(1e-5, force=0.1)
    return SensedContact(1e-3, 1, 1e5, 0.03, 0.3, 0.7, 0.7, 5.0, noise, True)


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
def analysis() -> Analysis:
    return dd.analyze(arm("two_link").model.dae, count=3)


@cache
def pinned_motion() -> PinnedMotion:
    dynamics = dd.ZeroDynamics(arm("two_link").model.dae, structure=arm("two_link").structure)
    return dynamics.motion(lambda t: record()["reference"][0], [0.0, 0.1])


@cache
def scenario() -> Scenario:
    return dd.load_scenario(find_scenario("two_link_wall"))


# A value of each type that is fine where nothing else is said.
SAMPLES: dict[Any, Callable[[], Any]] = {
    Any: lambda: 1.0,
    ArrayLike: lambda: 1.0,
    bool: lambda: False,
    float: lambda: 0.5,
    int: lambda: 1,
    str: lambda: "tool",
    ca.SX: lambda: ca.SX.sym("p", 3),
    Block: lambda: loop().plant.block,
    Assumption: lambda: SAMPLES[Analysis]().assumptions[0],
    Diagram: lambda: loop().diagram,
    Analysis: analysis,
    dd.ClosedLoop: loop,
    dd.ContactMaterial: dd.ContactMaterial,
    PointMaterial: PointMaterial,
    Controller: lambda: loop().controller,
    Plant: lambda: loop().plant,
    dd.DaeSystem: lambda: arm("two_link").model.dae,
    FeedbackGains: lambda: law("two_link").gains,
    dd.Sampling: lambda: dd.Sampling(0.01),
    dd.Encoders: lambda: dd.Encoders(1e-5),
    Observing: lambda: Observing(10.0),
    SensedContact: sensed,
    SensorNoise: lambda: SensorNoise(),
    dd.NormalForm: normal_form,
    Manifold: lambda: arm("two_link").structure.manifold,
    Derivatives: lambda: arm("two_link").structure.derivatives,
    Elimination: lambda: arm("two_link").structure.elimination,
    RankMargin: lambda: arm("two_link").structure.control_margin,
    PathLimits: lambda: PathLimits(0.2, 1.0),
    dd.Record: record,
    dd.ReferenceGenerator: lambda: loop().reference,
    dd.RobotModel: lambda: arm("two_link").model,
    dd.Signal: lambda: dd.Signal("a"),
    dd.TrackingLaw: lambda: law("two_link"),
    Constraint: lambda: arm("two_link").model.constraints[0],
    Context: lambda: context_of(None),
    Links: lambda: arm("two_link").model.links,
    MultibodyPlant: lambda: arm("two_link").plant,
    Recorded: lambda: Recorded(np.zeros((2, 1)), (dd.Signal("a"),)),
    Scenario: scenario,
    Surface: lambda: dd.Plane((0, 0, 0), (0, 0, 1)),
    System: lambda: loop().diagram,
    Trajectory: lambda: PiecewisePolynomial.CubicHermite([0, 1], [[0, 1]], [[0, 0]]),
}

# What fits an argument with a name, of all names or of one.
PLACES: dict[str, Callable[[], Any]] = {
    "states": lambda: state()[None],
    "times": lambda: [0.0, 0.1],
    "reference": lambda: record()["reference"][0],
    "add_robot": lambda: add_arm,
    "limits of ControlLimits": lambda: [1.0],
    "axis": lambda: (0.0, 0.0, 1.0),
    "axis of AxisCoordinates": lambda: "z",
    "major_radius": lambda: 2.0,
    "size": lambda: 1,
    "components": lambda: "xy",
    "duration": lambda: 0.01,
    "law of StateEstimator": observed_law,
    "observing of StateEstimator": lambda: Observing(10.0, state_rate=40.0),
    "center": lambda: (0.0, 0.0, 0.0),
    "degrees": lambda: [2],
    "outputs": lambda: [0.3, 10.0],
    "plant of make_closed_loop": lambda: dd.RobotPlant(
        arm("two_link").model, structure=arm("two_link").structure
    ),
    "phases": lambda: [dd.Approach()],
    "references of Move": lambda: {"tool.z": 0.3},
    "force of Press": lambda: 20.0,
    "of": lambda: "force",
    "task": lambda: dd.Task([dd.Approach()]),
    "law of TaskController": lambda: laws()[0],
    "free_law": lambda: laws()[1],
    "controller of wire_loop": lambda: dd.TaskController(
        dd.Task([dd.Approach()]), laws()[0], laws()[1], sample_period=1e-3
    ),
    "integrators": lambda: {"joint1_motor": 1},
    "count": lambda: 3,
    "structure": lambda: arm("two_link").structure,
    "name": lambda: "name",
    "time": lambda: ca.SX.sym("t"),
    "values": lambda: -1.0,
    "state of DaeSystem": lambda: ca.SX.sym("x", 1),
    "state of from_symbolic": lambda: [Variable("x")],
    "f of from_symbolic": lambda: [1.0],
    "outputs of ExpressionOutput": lambda: [dd.Signal("a")],
    "second": lambda: "other",
    "follower": lambda: "joint1",
    "matrix": lambda: [[4.0, 4.0]],
    "end_time": lambda: 1.0,
    "time of Record": lambda: [0.0, 1.0],
    "references": lambda: [dd.ConstantReference([0.3, 10.0])],
    "references of ReferenceGenerator": lambda: [dd.ConstantReference(0.3)],
    "points of PolylineReference": lambda: [[0.0], [1.0]],
    "points of WaypointsReference": lambda: [[0.0], [1.0]],
    "file of CsvReference": lambda: str(
        Path(__file__).parent / "systems" / "control" / "steps.csv"
    ),
    "columns of CsvReference": lambda: ["x"],
    "q": lambda: ca.SX.sym("q"),
    "v": lambda: ca.SX.sym("v"),
    "mass_matrix": lambda: ca.SX(2.0),
    "bias": lambda: ca.SX(0.0),
    "path": lambda: find_scenario("two_link_wall"),
    "size of MeasuredSurface": lambda: (0.4, 0.3),
    "heights": lambda: [[0.0, 0.1], [0.0, 0.2]],
    "file": lambda: None,
    "log": lambda: loop().log,
    "groups": lambda: [np.eye(1), np.eye(1)],
    "starts": state,
    "parameters of rollout": lambda: None,
}

# What makes no sense for most arguments: wrong types, no numbers, wrong shapes.
NONSENSE: tuple[Any, ...] = (
    "text",
    None,
    float("nan"),
    True,
    -1,
    [],
    [float("nan")],
    [[1.0], [1.0, 2.0]],
    {},
    {1: "a"},
    np.zeros((3, 3)),
    np.array(["a"]),
    object(),
)

# What is not called here, and why.
LEFT_OUT = {
    "Phase": "its members are made, such as Press",
    "Scenario": "a form that is read from data, with its own tests of wrong ones",
    "start_meshcat": "it opens a port",
    "write_page": "it writes to the given path",
    "sweep": "it writes to the given path",
}


def public() -> Iterator[str]:
    """Functions, and classes of which a user makes members."""
    for name in dd.__all__:
        member = getattr(dd, name)
        is_class = inspect.isclass(member)
        if is_class and (issubclass(member, (Exception, Enum)) or inspect.isabstract(member)):
            continue
        if callable(member) and name not in LEFT_OUT:
            yield name


def sample(owner: str, name: str, hint: Any) -> Any:
    for place in (f"{name} of {owner}", name):
        if place in PLACES:
            return PLACES[place]()
    return sample_of(hint, f"{owner}: {name}")


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


def tried(name: str) -> None:
    """Calls a public name with each value of NONSENSE as each of its arguments."""
    member = getattr(dd, name)
    hints = get_type_hints(member.__init__ if inspect.isclass(member) else member)
    every = inspect.signature(member).parameters
    parameters = {key: one for key, one in every.items() if one.kind is not one.VAR_KEYWORD}
    star = [p.name for p in parameters.values() if p.kind is p.VAR_POSITIONAL]
    for wrong in parameters:
        for value in NONSENSE:
            arguments = {
                key: sample(name, key, hints.get(key, Any))
                for key, parameter in parameters.items()
                if parameter.default is parameter.empty and key != wrong
            }
            arguments[wrong] = value
            rest = [arguments.pop(key) for key in star]
            with contextlib.suppress(DrakeDaeError):
                member(*rest, **arguments)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", list(public()))
def test_wrong_arguments_end_as_errors_of_the_library(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tried(name)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: dd.Plane((0, 0), (0, 0, 1)), "point"),
        (lambda: dd.PointOnSurface("tool", 3.0), "surface"),
        (lambda: dd.Task([dd.Approach(), 3]), r"phases\[1\]"),
        (lambda: dd.Move({"tool.z": "up"}, duration=1.0), r"references\['tool.z'\]"),
        (lambda: dd.RobotModel.from_multibody(3, []), "plant"),
        (lambda: dd.Sampling("0.1"), "0.1"),
    ],
)
def test_the_argument_and_the_value_are_named(call, named):
    with pytest.raises(DrakeDaeError, match=named):
        call()


def test_what_runs_in_a_loop_is_not_checked():
    """A check takes some 20 us; the law is called at each step."""
    for method in (dd.TrackingLaw.control, dd.DaePlant.state, dd.Reference.derivatives):
        assert not hasattr(method, "__wrapped__")


def test_no_thread_collects_garbage_while_expressions_are_built():
    seen = []

    @checked(ModelError)
    class Built:
        def __init__(self, inner: bool) -> None:
            seen.append(gc.isenabled())
            if inner:
                Built(False)
                seen.append(gc.isenabled())
                raise KeyError

    was = gc.isenabled()
    try:
        for enabled in (True, False):
            (gc.enable if enabled else gc.disable)()
            with pytest.raises(KeyError):
                Built(True)
            assert gc.isenabled() is enabled
    finally:
        (gc.enable if was else gc.disable)()
    assert seen == [False] * 6


def test_what_is_built_waits_for_a_collection_in_another_thread():
    gc.collect()  # So that the other thread frees nothing of CasADi or Drake.
    begun, end, built = (threading.Event() for _ in range(3))

    class Slow:
        def __del__(self):
            begun.set()
            assert end.wait(60.0)

    def collect():
        slow = Slow()
        slow.itself = slow
        del slow
        gc.collect()

    @uncollected
    def build():
        built.set()

    threads = [threading.Thread(target=collect), threading.Thread(target=build)]
    threads[0].start()
    assert begun.wait(60.0)
    threads[1].start()
    assert not built.wait(0.2)
    end.set()
    for thread in threads:
        thread.join()
    assert built.is_set()
