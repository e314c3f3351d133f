"""The figures that a user asks for first, each beside its counterpart in one run.

Counterparts are the same interpreted, the same in Drake with blocks that do nothing, and bare
imports. What is compared computes the same, which is checked first. Peers stand in `test_peers`.
"""

import subprocess
import sys
import time

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia
from runs import scenario
from test_speed import empty_loop, stepping
from timing import calls, has_compiler, race, times
from two_arms import two_arms

from drake_dae import (
    DcMotors,
    FlexibleJoints,
    JointPositions,
    Plane,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    TrackingLaw,
    build_scenario,
    poles,
    rollout,
    simulate,
)
from drake_dae.running import start_values

SPRINGS = FlexibleJoints(8000.0, inertia=1.0)
MOTORS = DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)
FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=1e-3",
]
CHOICES = {"interpreted": "false", "machine code": "true"}


def choices() -> dict[str, str]:
    """How functions run, and the choice of a scenario that makes them so."""
    return {name: text for name, text in CHOICES.items() if text == "false" or has_compiler()}


def loops(name: str, *settings: str):
    """A scenario for each choice: how it runs, the scenario, its loop, and its start."""
    for how, compiled in choices().items():
        chosen = scenario(name, *settings, f"compiled={compiled}")
        yield how, chosen, *build_scenario(chosen)


LAWS = {
    "7 rigid joints": "seven_joint_wall",
    "7 flexible joints": "seven_joint_flexible",
    "7 flexible joints, motors": "seven_joint_flexible_motors",
    "14 rigid joints, 6 constraints": "two_arms",
}


@pytest.mark.parametrize("label", LAWS)
def test_law(label, compare):
    laws = [loop.controller.law for _, _, loop, _ in loops(LAWS[label])]
    law, state = laws[0], laws[0].system.nominal_state
    reference = np.linspace(0.1, 0.5, len(law.reference_signals))
    functions = [one.function for one in (laws * 2)[:2]]
    for one, two in zip(
        *(f(state, reference, law.all_parameters()) for f in functions), strict=True
    ):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12 * np.abs(two).max())
    took = times(calls(functions, state, reference, law.all_parameters()))
    for how in [how for how in took if how != "interpreted"]:
        compare(f"law, {label}: {how}", took[how], "interpreted", took["interpreted"])


def test_closed_loop(compare):
    """In Drake: a derivative at a new state, and a step of 1 ms with its projection."""
    for how, _, loop, context in loops("seven_joint_wall"):
        law = loop.controller.law
        sizes = law.system.num_states, len(law.reference_signals), law.system.num_controls
        pairs = {"ours": (loop.diagram, context), "empty": empty_loop(*sizes)}
        timed = {}
        for name, (diagram, at) in pairs.items():
            state = at.get_continuous_state_vector().CopyToVector()
            rate = diagram.AllocateTimeDerivatives()

            def touch(at=at, state=state):
                at.SetTime(0.5)
                at.SetContinuousState(state)

            timed[f"touch {name}"] = touch
            timed[name] = lambda touch=touch, diagram=diagram, at=at, rate=rate: (
                touch(),
                diagram.CalcTimeDerivatives(at, rate),
            )
        took = race(timed)
        ours, empty = (took[name] - took[f"touch {name}"] for name in pairs)
        figure = f"derivative of the closed loop, 7 joints: {how}"
        compare(figure, ours, "empty blocks", empty, wanted=3.0 if how == "interpreted" else 1.5)
        runs = [
            stepping(loop.diagram, loop.diagram.CreateDefaultContext()),
            stepping(*pairs["empty"]),
        ]
        found = np.array([[run() for run in runs] for _ in range(30)]).min(axis=0) * 1e-6
        compare(f"1 ms step of it, RK3, projected: {how}", found[0], "empty blocks", found[1])


@pytest.mark.parametrize("case", ["1 ms steps", "accuracy 1e-8"])
def test_rollout(case, compare):
    """Ten seconds, records and all, beside `simulate` interpreted; the same end to 1e-6."""
    settings = FIXED if case == "1 ms steps" else ["integrator.accuracy=1e-8"]
    chosen = scenario("seven_joint_wall", "duration=10", "compiled=false", *settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    moments = np.linspace(0.0, 10.0, 10001 if case == "1 ms steps" else 1001)
    ends = {}

    def drake():
        own = loop.diagram.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        simulate(loop.diagram, own, chosen.duration, chosen.integrator)
        ends["simulate"] = loop.record(own)["state"][-1]

    def rolled(how):
        (done,) = rollout(
            loop,
            start,
            parameters,
            moments,
            config=chosen.integrator,
            compiled=how != "interpreted",
        )
        ends[how] = done.record["state"][-1]

    own = {how: lambda how=how: rolled(how) for how in choices()}
    for function in own.values():
        function()  # The first compiles.
    took = race({"simulate": drake, **own}, rounds=3, number=1)
    for how in own:
        np.testing.assert_allclose(ends[how], ends["simulate"], rtol=0.0, atol=1e-6)
        figure = f"10 s of 7 joints on a wall, {case}: rollout, {how}"
        compare(figure, took[how], "simulate", took["simulate"])


def test_projection(compare):
    """Of a state that a step has left 1e-7 off N*: two arms that hold a box."""
    found = {}
    for how, _, loop, _ in loops("two_arms"):
        manifold = loop.plant.structure.manifold
        values = manifold.system.parameter_values
        nominal = manifold.project(manifold.system.nominal_state)
        state = nominal + 1e-7 * np.random.default_rng(0).normal(size=nominal.size)
        for _ in range(2):
            assert np.abs(manifold.residual(manifold.project(state))).max() < 1e-13
        found[how] = lambda m=manifold, x=state, p=values: m.projected(x, p)
    took = race(found)
    if "machine code" in took:
        figure = "projection of a state, 14 joints in a loop: machine code"
        compare(figure, took["machine code"], "interpreted", took["interpreted"])


def arms_with_motors() -> RobotModel:
    """14 joints with springs and motors, and a weld."""
    return two_arms([SPRINGS, MOTORS])


def flexible_snake() -> RobotModel:
    """30 joints with springs, the last link on a floor."""
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia(1.0, [0.05, 0.0, 0.0], UnitInertia(0.02, 0.02, 0.02))
    end = plant.world_frame()
    for i in range(30):
        body = plant.AddRigidBody(f"link{i}", inertia)
        joint = RevoluteJoint(f"j{i}", end, body.body_frame(), np.eye(3)[2 - i % 3])
        plant.AddJointActuator(f"motor{i}", plant.AddJoint(joint))
        pose = RigidTransform([0.1, 0.0, 0.0])
        end = plant.AddFrame(FixedOffsetFrame(f"end{i}", body.body_frame(), pose))
    plant.Finalize()
    floor = PointOnSurface("link29", Plane([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]))
    outputs = [JointPositions([f"j{i}" for i in range(30) if i != 26])]
    bent = 0.3 * np.sin(np.arange(30))
    return RobotModel.from_multibody(plant, [floor], outputs, bent, "snake", [SPRINGS])


TRACED = {
    "14 joints with springs and motors": (arms_with_motors, 5.0),
    "30 joints with springs": (flexible_snake, 8.0),
}


@pytest.mark.parametrize("label", TRACED)
def test_tracing(label, compare):
    """Model with its comparison to the plant, structure, law and plant; nothing is compiled."""
    make, wanted = TRACED[label]
    seconds = []
    for _ in range(2):
        began = time.process_time()
        model = make()
        law = TrackingLaw(model.dae, poles(-4.0))
        RobotPlant(model, structure=law.structure)
        seconds.append(time.process_time() - began)
    compare(f"tracing, {label}", min(seconds), wanted=wanted)


def test_starting(compare):
    def seconds(*words):
        began = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        return time.perf_counter() - began

    pairs = {
        "drake-dae list": (("-m", "drake_dae", "list"), "import numpy"),
        "import of drake_dae and its parts": (
            ("-c", "import drake_dae; drake_dae.build_scenario, drake_dae.simulate"),
            "import pydrake.all, casadi",
        ),
    }
    for figure, (words, bare) in pairs.items():
        found = np.array([[seconds(*words), seconds("-c", bare)] for _ in range(5)])
        ours, theirs = found.min(axis=0)
        compare(figure, ours, bare, theirs)
