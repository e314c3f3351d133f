"""More controls than outputs: the control next to a free one in a metric."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.analysis import Simulator

from drake_dae import (
    DaePlant,
    DaeSystem,
    NormalForm,
    Parameter,
    SinusoidReference,
    TrackingController,
    TrackingLaw,
    ZeroDynamics,
    dynamic_extension,
    find_structure,
    make_closed_loop,
    poles,
)
from drake_dae.dae import Verdict, extend
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import nearest_solution

BY_U = np.array([[1.0, 0.4, -0.7, 0.2], [0.3, -1.1, 0.5, 0.9], [0.2, 0.6, 1.3, -0.8]])
ROOT = np.array(
    [[1.2, 0.0, 0.0, 0.0], [0.3, 0.9, 0.0, 0.0], [-0.2, 0.1, 1.4, 0.0], [0.5, 0.0, 0.2, 1.1]]
)
METRIC = ROOT @ ROOT.T


def sled(**choice) -> DaeSystem:
    """Three masses, four thrusters that move all of them; the third is held on x2 = sin x0.

    With p = (x0, x1, x2) and v = p': p' = v, v' = d(p, v) + G(p)^T lambda + H(p) u, where
    G = (-cos x0, 0, 1); the outputs are x0 and lambda.
    """
    x = ca.SX.sym("x", 6)
    p, v = x[:3], x[3:]
    gradient = ca.vertcat(-ca.cos(p[0]), 0.0, 1.0)
    by_control = ca.SX(BY_U) * (1.0 + 0.1 * p[1])
    drift = ca.vertcat(-ca.sin(p[1]), -p[1] - 0.5 * v[1], -9.81)
    free = Parameter("free", np.zeros(4), "N")
    metric = ca.SX(METRIC) + 0.3 * ca.diag(ca.vertcat(p[0] ** 2, 0.0, 0.0, p[1] ** 2))
    options = {"control_metric": metric, "free_control": free.symbol, **choice}
    return DaeSystem(
        state=x,
        f=ca.vertcat(v, drift),
        g=ca.vertcat(ca.SX(3, 1), gradient),
        h=ca.vertcat(ca.SX(3, 4), by_control),
        k=p[2] - ca.sin(p[0]),
        l=ca.vertcat(p[0], 0.0),
        m=ca.vertcat(0.0, 1.0),
        parameters=(free,),
        name="sled",
        **options,
    )


def by_hand(x, wanted):
    """a, B and W of the sled by NumPy: lambda and x0'' for no control, and for a unit of each."""
    p, v = x[:3], x[3:]
    gradient = np.array([-np.cos(p[0]), 0.0, 1.0])
    columns = BY_U * (1.0 + 0.1 * p[1])
    drift = np.array([-np.sin(p[1]), -p[1] - 0.5 * v[1], -9.81])
    bend = np.sin(p[0]) * v[0] ** 2
    size = gradient @ gradient
    force, by_force = -(gradient @ drift + bend) / size, -(gradient @ columns) / size
    a = np.array([drift[0] + gradient[0] * force, force])
    B = np.vstack([columns[0] + gradient[0] * by_force, by_force])
    W = METRIC + 0.3 * np.diag([p[0] ** 2, 0.0, 0.0, p[1] ** 2])
    inverse = np.linalg.solve(W, B.T) @ np.linalg.inv(B @ np.linalg.solve(W, B.T))
    return inverse @ (wanted - a), np.eye(4) - inverse @ B, W


@pytest.fixture(scope="module")
def law() -> TrackingLaw:
    return TrackingLaw(sled(), poles(-3.0))


def consistent(law, random):
    return law.structure.manifold.project(random.uniform(-1.0, 1.0, 6))


def test_the_nearest_solution_is_that_of_numpy():
    """By the normal equations in NumPy, of matrices with conditions up to 100: 1e-12."""
    random = np.random.default_rng(0)
    for p, size in ((1, 2), (2, 2), (3, 7)):
        B, b = random.standard_normal((p, size)), random.standard_normal(p)
        root, goal = random.standard_normal((size, size)), random.standard_normal(size)
        W = root @ root.T + 0.1 * np.eye(size)
        found, pivot = nearest_solution(*map(ca.SX, (B, b, W, goal)))
        weak = np.linalg.solve(W, B.T)
        expected = goal + weak @ np.linalg.solve(B @ weak, b - B @ goal)
        assert_allclose(ca.DM(found).full().ravel(), expected, rtol=1e-11, atol=1e-11)
        assert 0.0 < float(pivot) <= 1.0
    B[2] = B[0] - B[1]
    assert float(nearest_solution(*map(ca.SX, (B, b, W, goal)))[1]) < 1e-14


def test_the_law_is_the_weighted_right_inverse(law):
    """Against NumPy by hand, with a metric that depends on the state, to round-off."""
    random = np.random.default_rng(1)
    assert law.structure.output_degrees == (2, 0)
    assert law.structure.control_matrix.shape == (2, 4)
    for _ in range(5):
        x, R, free = consistent(law, random), random.uniform(-1, 1, 4), random.uniform(-5, 5, 4)
        ubar = [R[2] - 6.0 * (x[3] - R[1]) - 9.0 * (x[0] - R[0]), R[3]]
        least, onto_null, _ = by_hand(x, np.array(ubar))
        assert_allclose(law.control(x, R), least, rtol=1e-11, atol=1e-11)
        expected = least + onto_null @ free
        assert_allclose(law.control(x, R, parameters=free), expected, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_outputs_are_as_predicted_and_a_free_control_moves_none_of_them(law):
    """At an accuracy of 1e-9 in a step some 1e-8 are left along the way."""
    records = []
    for amplitude in (0.0, 3.0):
        system = sled().with_exogenous(["free"])
        structure = find_structure(system)
        moving = TrackingLaw(system, poles(-3.0), structure=structure)
        references = [SinusoidReference(0.0, [0.5], [1.0]), SinusoidReference(2.0, [1.0], [1.5])]
        exogenous = [SinusoidReference(0.0, [amplitude], [2.0 + k]) for k in range(4)]
        plant = DaePlant(system, structure=structure)
        loop = make_closed_loop(plant, moving, references, LoopSettings(exogenous=exogenous))
        simulator = Simulator(loop.diagram)
        simulator.get_mutable_integrator().set_target_accuracy(1e-9)
        context = simulator.get_mutable_context()
        plant.set_consistent_state(
            plant.GetMyMutableContextFromRoot(context), [0.3, 0.2, 0.3, 0, 0, 0]
        )
        simulator.AdvanceTo(1.0)
        record = loop.record(context)
        predicted = loop.predicted_error(record)
        assert_allclose(record["tracking_error"], predicted, atol=2e-8)
        assert np.abs(record["tracking_error"][0, 0]) > 0.2
        records.append(record)
    still, pressed = records
    assert abs(pressed["state"][-1, 1] - still["state"][-1, 1]) > 0.1  # It moves what is free.


def spare(free=None) -> DaeSystem:
    """z'' = u_1 + 2 u_2 is steered, and s'' = -4 s - 0.2 s' + u_1 - u_2 is not."""
    x = ca.SX.sym("x", 4)
    h = ca.vertcat(ca.SX(2, 2), ca.SX([[1.0, 2.0], [1.0, -1.0]]))
    f = ca.vertcat(x[2:], 0.0, -4.0 * x[1] - 0.2 * x[3])
    chosen = None if free is None else free(x)
    parts = (ca.SX(4, 0), h, ca.SX(0, 1), x[0], ca.SX(1, 0))
    metric = np.diag([1.0, 3.0])
    return DaeSystem(x, f, *parts, control_metric=metric, free_control=chosen)


@pytest.mark.slow
def test_zero_dynamics_are_those_under_the_chosen_control():
    """By hand: with z = 0 the control is u_0 - B^+ B u_0, where B = (1, 2) and B^+ = (3, 2) / 7 by
    W = diag(1, 3). For u_0 = (c, 0) that is (4, -2) c / 7, of which s gets 6 c / 7."""
    system = spare()
    assert ZeroDynamics(system).dimension == 2
    found = ZeroDynamics(system).stability()
    assert found.verdict is Verdict.STABLE
    assert_allclose(sorted(found.eigenvalues.real), [-0.1, -0.1], atol=1e-9)
    damped = spare(lambda x: ca.vertcat(-7.0 / 6.0 * x[3], 0.0))
    found = ZeroDynamics(damped).stability()
    assert_allclose(sorted(found.eigenvalues.real), [-0.6, -0.6], atol=1e-9)
    grows = spare(lambda x: ca.vertcat(0.7 * x[3], 0.0))
    assert ZeroDynamics(grows).stability().verdict is Verdict.UNSTABLE


@pytest.mark.equation(27)
def test_the_realization_moves_as_the_plant(law):
    """(26), (27) are the rates of the plant's state, in the coordinates."""
    random, structure = np.random.default_rng(3), law.structure
    form, plant = NormalForm(law.system, structure=structure), DaePlant(law.system)
    context = plant.CreateDefaultContext()
    for _ in range(3):
        x, u = consistent(law, random), random.uniform(-1.0, 1.0, 4)
        plant.set_state(context, x)
        plant.GetInputPort("control").FixValue(context, u)
        expected = form.jacobian(x) @ plant.EvalTimeDerivatives(context).CopyToVector()
        found = form.rates(x, u)
        assert_allclose(found, expected[-found.size :], rtol=1e-9, atol=1e-9)


def test_the_controller_has_the_gradients_of_the_choice(law):
    """By AutoDiffXd and by central differences of 1e-6, so 1e-7."""
    random = np.random.default_rng(6)
    controller = TrackingController(law)
    assert controller.GetOutputPort("control").size() == 4
    assert controller.GetOutputPort("tracking_error").size() == 2
    converted = controller.ToAutoDiffXd()
    context = converted.CreateDefaultContext()
    x, R = consistent(law, random), random.uniform(-1.0, 1.0, 4)
    converted.GetInputPort("estimated_state").FixValue(context, InitializeAutoDiff(x))
    converted.GetInputPort("reference").FixValue(context, R)
    value = converted.GetOutputPort("control").Eval(context)
    assert_allclose(ExtractValue(value).ravel(), law.control(x, R), rtol=1e-14)
    steps = 1e-6 * np.eye(6)
    expected = [(law.control(x + dx, R) - law.control(x - dx, R)) / 2e-6 for dx in steps]
    assert_allclose(ExtractGradient(value), np.array(expected).T, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: find_structure(replace(sled(), control_metric=None, free_control=None)),
            "control_metric",
        ),
        (lambda: sled(control_metric=None), r"free_control.*control_metric"),
        (lambda: sled(control_metric=np.eye(3)), r"control_metric.*\(3, 3\)"),
        (lambda: sled(free_control=np.zeros(3)), r"free_control.*\(3, 1\)"),
        (lambda: find_structure(sled(control_metric=np.diag([1, 1, 0, 1]))), "control_metric"),
        (lambda: find_structure(sled(control_metric=ROOT)), "control_metric"),
        (lambda: dynamic_extension(sled()), "control_metric"),
        (lambda: extend(sled(), ["u0"]), "control_metric"),
        (
            lambda: DaeSystem.from_functions(
                1, f=lambda x: -x, h=lambda x: 1.0, l=lambda x: x, control_metric=np.eye(1)
            ),
            "control_metric",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ModelError, match=message):
        make()
