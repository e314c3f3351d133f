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
from polishing import laws
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Variable
from pydrake.systems.framework import Context, Diagram, System

import drake_dae as dd
from drake_dae.arguments import checked, uncollected
from drake_dae.blocks.block import Block
from drake_dae.dae import FeedbackGains, with_disturbance
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
    read_robot(scenario().robot, plant, scene_graph)


@cache
def observed_law() -> dd.TrackingLaw:
    dae = with_disturbance(arm("two_link").model.dae, ["joint1_w", "joint2_w"])
    return dd.TrackingLaw(dae, dd.poles(-4.0))


@cache
def record() -> dd.Record:
    context = loop().diagram.CreateDefaultContext()
    dd.simulate(loop().diagram, context, 0.01, fixed_step())
    return loop().record(context)


@cache
def scenario() -> Scenario:
    return dd.load_scenario(find_scenario("two_link_wall"))


# A value of each type that is fine where nothing else is said.
SAMPLES: dict[Any, Callable[[], Any]] = {
    ArrayLike: lambda: 1.0,
    float: lambda: 0.5,
    str: lambda: "tool",
    ca.SX: lambda: ca.SX.sym("p", 3),
    Block: lambda: loop().plant.block,
    Diagram: lambda: loop().diagram,
    dd.ClosedLoop: loop,
    dd.ContactMaterial: dd.ContactMaterial,
    PointMaterial: PointMaterial,
    Controller: lambda: loop().controller,
    Plant: lambda: loop().plant,
    dd.DaeSystem: lambda: arm("two_link").model.dae,
    FeedbackGains: lambda: law("two_link").gains,
    PathLimits: lambda: PathLimits(0.2, 1.0),
    dd.Record: record,
    dd.ReferenceGenerator: lambda: loop().reference,
    dd.RobotModel: lambda: arm("two_link").model,
    dd.Signal: lambda: dd.Signal("a"),
    dd.TrackingLaw: lambda: law("two_link"),
    Constraint: lambda: arm("two_link").model.constraints[0],
    Context: lambda: loop().diagram.CreateDefaultContext(),
    Links: lambda: arm("two_link").model.links,
    Recorded: lambda: Recorded(np.zeros((2, 1)), (dd.Signal("a"),)),
    Scenario: scenario,
    Surface: lambda: dd.Plane((0, 0, 0), (0, 0, 1)),
    System: lambda: loop().diagram,
}

# What fits an argument with a name, of all names or of one.
PLACES: dict[str, Callable[[], Any]] = {
    "times": lambda: [0.0, 0.1],
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
    "plant of make_closed_loop": lambda: dd.RobotPlant(
        arm("two_link").model, structure=arm("two_link").structure
    ),
    "phases": lambda: [dd.Approach()],
    "references of Move": lambda: {"tool.z": 0.3},
    "force of Press": lambda: 20.0,
    "task": lambda: dd.Task([dd.Approach()]),
    "law of TaskController": lambda: laws()[0],
    "free_law": lambda: laws()[1],
    "structure": lambda: arm("two_link").structure,
    "name": lambda: "name",
    "values": lambda: -1.0,
    "state of DaeSystem": lambda: ca.SX.sym("x", 1),
    "state of from_symbolic": lambda: [Variable("x")],
    "f of from_symbolic": lambda: [1.0],
    "outputs of ExpressionOutput": lambda: [dd.Signal("a")],
    "second": lambda: "other",
    "follower": lambda: "joint1",
    "end_time": lambda: 1.0,
    "time of Record": lambda: [0.0, 1.0],
    "references": lambda: [dd.ConstantReference([0.3, 10.0])],
    "references of ReferenceGenerator": lambda: [dd.ConstantReference(0.3)],
    "points of PolylineReference": lambda: [[0.0], [1.0]],
    "points of WaypointsReference": lambda: [[0.0], [1.0]],
    "file of CsvReference": lambda: str(Path(__file__).parent / "systems" / "steps.csv"),
    "columns of CsvReference": lambda: ["x"],
    "q": lambda: ca.SX.sym("q"),
    "v": lambda: ca.SX.sym("v"),
    "mass_matrix": lambda: ca.SX(2.0),
    "bias": lambda: ca.SX(0.0),
    "path": lambda: find_scenario("two_link_wall"),
    "file": lambda: None,
    "log": lambda: loop().log,
    "starts": lambda: arm("two_link").structure.states[0],
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
