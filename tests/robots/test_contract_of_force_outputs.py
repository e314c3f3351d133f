"""The rules of `ForceOutput`, on every member: on the puck that three fingers hold."""

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
import pytest
from members import Pull, subclasses
from runs import scenario

from drake_dae import (
    CoincidentPoints,
    ForceCombination,
    ForceOutput,
    JointCoupler,
    RobotModel,
    Signal,
    Squeeze,
)
from drake_dae.errors import ModelError
from drake_dae.robots import ConstraintSet, as_force_outputs, force_rows
from drake_dae.scenario.model import scenario_model
from drake_dae.trace.functions import TracedFunction

MEMBERS = {
    "combination": ForceCombination({"grip1.fz": 0.5, "grip3.fz": -0.5}, "share"),
    "squeeze": Squeeze("object", "grip1", "grip2"),
    "squeeze of the fingers": Squeeze("finger1::tip", "grip1", "other", name="pinch"),
    "own": Pull("object", "grip3", (0.6, 0.0, 0.8)),
}


@cache
def robot() -> RobotModel:
    return scenario_model(scenario("three_fingers"))


def bound() -> ConstraintSet:
    coupler = JointCoupler("finger1::joint3", "finger1::joint2", name="gear")
    tip = CoincidentPoints("finger1::tip", (0, 0, -0.02), "world", (0, 0, 0), name="other")
    return ConstraintSet([*robot().constraints, tip, coupler])


@pytest.fixture(params=MEMBERS)
def output(request):
    return MEMBERS[request.param]


def rows(output: ForceOutput, q: np.ndarray) -> np.ndarray:
    links, constraints = robot().links, bound()
    S = force_rows([output], constraints, links)
    parameters = robot().dae.parameter_symbol
    function = TracedFunction("rows", {"q": links.q, "p": parameters}, {"S": S})
    return function(q, robot().dae.parameter_values)[0].reshape(-1, constraints.size)


def test_no_member_is_left_out():
    assert subclasses(ForceOutput) <= {type(output) for output in MEMBERS.values()}


def test_rows_are_as_many_as_names(output):
    names = [signal.name for signal in output.signals(bound())]
    q = np.random.default_rng(0).uniform(-0.5, 0.5, robot().links.q.numel())
    S = rows(output, q)
    assert len(set(names)) == len(names) == len(S) > 0
    assert np.linalg.matrix_rank(S) == len(S)


def test_rows_are_functions_of_positions_alone(output):
    S = force_rows([output], bound(), robot().links)
    assert not ca.depends_on(S, robot().links.v)


@pytest.mark.equation(40)
def test_rows_of_names_and_combinations_are_their_weights():
    q = np.zeros(robot().links.q.numel())
    expected = np.zeros((1, bound().size))
    expected[0, [2, 8]] = 0.5, -0.5
    np.testing.assert_array_equal(rows(MEMBERS["combination"], q), expected)
    (named,) = as_force_outputs(["grip2.fz"], bound())
    assert named.signals(bound()) == (Signal("grip2.fz", "N"),)
    np.testing.assert_array_equal(rows(named, q), np.eye(bound().size)[[5]])


@pytest.mark.parametrize("name", ["squeeze", "squeeze of the fingers"])
def test_a_squeeze_is_half_the_force_toward_the_other_contact(name):
    """e_ij / 2 of what acts on the frame at i and the opposite at j, places by Drake."""
    output, plant = MEMBERS[name], robot().links.plant
    q = np.random.default_rng(1).uniform(-0.5, 0.5, robot().links.q.numel())
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    places, signs, columns = [], [], []
    for constraint, part in bound().parts():
        if constraint.name in (output.first, output.second):
            model, _, own = constraint.frame_b.rpartition("::")
            instance = [plant.GetModelInstanceByName(model)] if model else []
            frame = plant.GetFrameByName(own, *instance)
            places.append(frame.CalcPoseInWorld(context) @ np.array(constraint.point_b))
            signs.append(1.0 if constraint.frame_b == output.frame else -1.0)
            columns.append(part)
    along = (places[1] - places[0]) / np.linalg.norm(places[1] - places[0])
    expected = np.zeros((1, bound().size))
    expected[0, columns[0]] = signs[0] * along / 2.0
    expected[0, columns[1]] = -signs[1] * along / 2.0
    np.testing.assert_allclose(rows(output, q), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (ForceCombination({"grip2.f": 1.0}, "a"), "'grip2.f'"),
        (Squeeze("object", "grip1", "grip4"), "'grip4'"),
        (Squeeze("finger1::tip", "grip1", "grip2"), "'grip2'.*'finger1::tip'"),
        (Pull("object", "grip", (1, 0, 0)), "'grip'"),
    ],
)
def test_what_is_unknown_is_named(output, message):
    with pytest.raises(ModelError, match=message):
        force_rows([output], bound(), robot().links)


@dataclass(frozen=True)
class Pressed(ForceOutput):
    """No member: it is not linear."""

    shift: float = 0.0

    def expression(self, constraints, kinematics, constraint_force):
        return constraint_force[0] + self.shift if self.shift else constraint_force[0] ** 2

    def signals(self, constraints):
        return (Signal("pressed", "N"),)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Squeeze("object", "grip1", "grip1"), "'grip1'"),
        (lambda: ForceCombination({}, "none"), "'none'"),
        (
            lambda: ForceCombination({"grip1.fx": 1.0, "gear.moment": 1.0}, "a").signals(bound()),
            "'a'",
        ),
        (lambda: as_force_outputs(["grip1.fx", "grip1.fx"], bound()), r"grip1\.fx"),
        (
            lambda: as_force_outputs([Squeeze("object", "grip1", "grip2")] * 2, bound()),
            r"grip1\.grip2\.squeeze",
        ),
        (lambda: force_rows([Pressed()], bound(), robot().links), "pressed"),
    ],
)
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()
