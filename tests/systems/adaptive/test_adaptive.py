"""The adaptive law: its proof by numbers, and what it does in closed loop."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from actuated import actuated
from arms import arm, consistent_states, error_controlled, fixed_step, law, numbers, touching
from numpy.testing import assert_allclose
from scipy.integrate import cumulative_simpson

from drake_dae import (
    AdaptiveController,
    AdaptiveLaw,
    ConstantReference,
    ForceSensor,
    JointPositions,
    LinkExpressions,
    LoopSettings,
    Observing,
    Parameter,
    ReferenceGenerator,
    RobotModel,
    RobotPlant,
    Sampling,
    SinusoidReference,
    TrackingController,
    TrackingLaw,
    UnilateralRobotPlant,
    find_structure,
    poles,
    rollout,
    simulate,
    start_values,
    wire_loop,
    with_disturbance,
)
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.adaptive.balance import ForceBalance

MASSES = {"two_link": {"link1.mass": 3.0, "link2.mass": 2.0}, "seven_joint": {"tool.mass": 2.0}}
MOVES = [SinusoidReference(0.3, 0.3, 1.5), SinusoidReference(20.0, 5.0, 2.0)]
RESTS = [ConstantReference(0.3), ConstantReference(20.0)]
HEAVY = 6.6
"""The mass of link2 in the plant; the law begins with 6."""


@cache
def viscous():
    """The two-link arm on a wall with viscous friction, which grows with no force."""
    smooth = touching("two_link")
    wall = replace(smooth.constraints[0], viscous_friction=4.0)
    model = RobotModel(smooth.links, [wall], smooth.outputs, [1.2, -1.6])
    return model, find_structure(model.dae)


@cache
def adaptive(name, force_rate=0.0, adapted=None):
    found = viscous() if name == "viscous" else (arm(name).model, arm(name).structure)
    chosen = dict(adapted) if adapted is not None else MASSES[name]
    return AdaptiveLaw(found[0], chosen, 4.0, 8.0, force_rate, found[1])


LINK2 = (("link2.mass", 2.0),)
DRAG = (("link2.mass", 2.0), ("wall.viscous_friction", 20.0))


def loop_of(controller, references=MOVES, period=0.0, changes=None, **settings):
    """The two-link arm, 5 cm off its reference at rest."""
    dae = controller.law.system
    model, structure = arm("two_link").model, arm("two_link").structure
    if isinstance(controller, AdaptiveController):
        model, structure = controller.adaptive.model, controller.adaptive.structure
    plant = RobotPlant(model, structure=structure)
    if period:
        settings["sampling"] = Sampling(period)
    generator = ReferenceGenerator(references, controller.law.degrees)
    loop = wire_loop(plant, controller, generator, LoopSettings(**settings))
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    for name, value in (changes or {"link2.mass": HEAVY}).items():
        plant.set_parameter(own, name, value)
    q = model.configuration([0.35], [1.2, -1.6])
    plant.set_consistent_state(own, [*q, *np.zeros(dae.num_states - q.size)])
    return loop, context


def run(controller, end, config=None, **more):
    loop, context = loop_of(controller, **more)
    simulate(loop.diagram, context, end, config or error_controlled(1e-9))
    return loop.record(context)


def roll(controller, end, config, **more):
    """The same as a rollout, with a row at each step."""
    loop, context = loop_of(controller, **more)
    times = np.linspace(0.0, end, round(end / config.max_step_size) + 1)
    (found,) = rollout(loop, *start_values(loop, context), times, config=config)
    assert found.failure is None
    return found.record


def energies(own, record, theta):
    """V and V' at the rows of a record."""
    memory = record["parameter_estimate"]
    if own.force_rate:
        memory = np.hstack([memory, record["force_integral"]])
    values = own.model.dae.parameter_values
    rows = zip(record["state"], record["reference"], memory, strict=True)
    found = [own.energy(x, R, m, values, theta) for x, R, m in rows]
    return np.array([[one[0][0], one[1][0]] for one in found]).T


def late(record, after):
    """The largest errors after a time, for each output."""
    return np.abs(record["tracking_error"][record.time > after]).max(axis=0)


@pytest.mark.parametrize("name", ["two_link", "seven_joint"])
def test_skew_symmetry_and_the_coriolis_forces_of_multibody_plant(name):
    """To 1e-10 of forces of some 100 N m."""
    balance = ForceBalance(arm(name).model, tuple(MASSES[name]))
    q, v, s = balance.q, balance.v, ca.SX.sym("s", balance.v.numel())
    turns = ca.reshape(ca.jtimes(ca.vec(balance.mass), q, v), balance.mass.shape)
    values = ca.Function(
        "values",
        [q, v, s, arm(name).model.dae.parameter_symbol],
        [ca.bilin(turns, s, s) / 2.0 - ca.dot(s, balance.coriolis(s)), balance.coriolis(s)],
    )
    random, parameters = np.random.default_rng(0), arm(name).model.dae.parameter_values
    for x in consistent_states(name, 5):
        at, speed = np.split(x, 2)
        power, _ = values(at, speed, random.normal(size=speed.size), parameters)
        assert abs(float(power)) < 1e-10
        _, own = values(at, speed, speed, parameters)
        known = numbers(name, at, speed).bias - numbers(name, at, 0.0 * speed).bias
        damping = numbers(name, at, 0.0 * speed).bias  # Odd parts of the bias are damping.
        odd = (numbers(name, at, speed).bias - numbers(name, at, -speed).bias) / 2.0
        assert_allclose(own.full()[:, 0], known - odd, atol=1e-10 * (1.0 + np.abs(damping).max()))


@pytest.mark.parametrize("name", ["two_link", "seven_joint", "viscous"])
def test_the_regressor_is_what_the_estimates_change(name):
    """Linear: a whole kilogram shows the derivative."""
    own = adaptive(name, adapted=DRAG if name == "viscous" else None)
    base = "two_link" if name == "viscous" else name
    dae, random = own.model.dae, np.random.default_rng(1)
    reference, theta = random.normal(size=own.layout.reference_size), own.start
    drive = np.array(ca.DM(dae.h[dae.num_states // 2 :, :]).full())
    for x in consistent_states(base, 3):
        given = x, reference, theta, dae.parameter_values
        regressor = own.energy(*given, theta)[2].copy().reshape(-1, theta.size)
        control, _, sliding = (part.copy() for part in own.function(*given))
        rate = own.rates(*given)[0].copy()
        assert_allclose(rate, -own.gamma * (regressor.T @ sliding), rtol=1e-12)
        for j in range(theta.size):
            other = theta.copy()
            other[j] += 1.0
            changed = own.function(x, reference, other, dae.parameter_values)[0]
            assert_allclose(drive @ (changed - control), regressor[:, j], rtol=0, atol=1e-9)


@pytest.mark.parametrize("force_rate", [0.0, 6.0])
@pytest.mark.parametrize("name", ["two_link", "seven_joint", "viscous"])
def test_v_falls_by_the_damping_along_the_motion_of_the_plant(name, force_rate):
    """V' by central differences along x', R' and the rates of estimates, far from the reference."""
    own = adaptive(name, force_rate, DRAG if name == "viscous" else None)
    dae, random = own.model.dae, np.random.default_rng(2)
    base, count = ("two_link" if name == "viscous" else name), len(own.signals)
    plant = RobotPlant(own.model, structure=own.structure)
    context = plant.CreateDefaultContext()
    lowest = own.layout.lowest[own.layout.dynamic]
    for x in consistent_states(base, 3):
        theta = own.start[:count] * random.uniform(0.7, 1.3, count)
        memory = own.memory(own.start[:count])
        memory[count:] = random.normal(size=memory.size - count)
        for signal, value in zip(own.signals, theta, strict=True):
            plant.set_parameter(context, signal.name, value)
        R = random.normal(size=own.layout.reference_size)
        R_rate = np.zeros_like(R)
        R_rate[lowest], R_rate[lowest + 1] = R[lowest + 1], R[lowest + 2]
        values = dae.parameter_values
        control = own.function(x, R, memory, values)[0].copy()
        plant.GetInputPort("control").FixValue(context, control)
        plant.set_consistent_state(context, x)
        x_rate = plant.EvalTimeDerivatives(context).CopyToVector()
        force = [plant.GetOutputPort("constraint_force").Eval(context)] if force_rate else []
        memory_rate = own.rates(x, R, *force, memory, values)[0].copy()

        def energy(h, x=x, R=R, m=memory, d=(x_rate, R_rate, memory_rate), theta=theta):
            at = x + h * d[0], R + h * d[1], m + h * d[2]
            return own.energy(*at, own.model.dae.parameter_values, theta)[0][0]

        h = 1e-5
        found = (8.0 * (energy(h) - energy(-h)) - energy(2 * h) + energy(-2 * h)) / (12.0 * h)
        wanted = own.energy(x, R, memory, values, theta)[1][0]
        assert wanted < 0.0
        assert found == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "force_rate", "adapted", "truth"),
    [
        ("two_link", 0.0, LINK2, {"link2.mass": HEAVY}),
        ("two_link", 10.0, None, {"link1.mass": 11.0, "link2.mass": HEAVY}),
        ("viscous", 0.0, DRAG, {"link2.mass": HEAVY, "wall.viscous_friction": 6.0}),
    ],
)
def test_v_falls_at_every_accepted_step(name, force_rate, adapted, truth):
    """V - V(0) is the integral of -s^T K s over the steps, to 1e-4 of V(0) by Simpson's rule."""
    own = adaptive(name, force_rate, adapted)
    record = run(AdaptiveController(own), 5.0, changes=truth)
    energy, rate = energies(own, record, list(truth.values()))
    assert len(record.time) > 100
    assert rate.max() <= 0.0
    assert np.diff(energy).max() < 1e-12 * energy[0]
    lost = cumulative_simpson(rate, x=record.time, initial=0.0)
    assert_allclose(energy - energy[0], lost, rtol=0.0, atol=1e-4 * energy[0])
    assert energy[-1] < 0.6 * energy[0]


@pytest.mark.slow
def test_it_tracks_where_the_law_of_the_wrong_model_does_not():
    """With link2 10 % heavier: 57 mm and 2.2 N without, nothing but the integrator's error with."""
    record = run(AdaptiveController(adaptive("two_link", adapted=LINK2)), 10.0)
    plain = run(TrackingController(law("two_link")), 10.0)
    assert late(plain, 8.0)[0] == pytest.approx(0.057, rel=0.05)
    assert late(plain, 8.0)[1] == pytest.approx(2.2, rel=0.05)
    assert late(record, 8.0)[0] < 1e-8
    assert late(record, 8.0)[1] < 1e-6
    assert record["parameter_estimate"][-1] == pytest.approx([HEAVY], abs=1e-8)


def test_where_nothing_excites_the_force_needs_its_measurement():
    """At rest gravity gives one equation for two masses: positions are right, the force is not."""
    changes = {"link1.mass": 11.0, "link2.mass": HEAVY}
    ends = {}
    for rate in (0.0, 10.0):
        controller = AdaptiveController(adaptive("two_link", rate))
        record = run(controller, 10.0, references=RESTS, changes=changes)
        apart = record["parameter_estimate"][-1] - [11.0, HEAVY]
        assert np.abs(apart).max() > 0.1
        assert late(record, 9.0)[0] < 1e-5
        ends[rate] = late(record, 9.0)[1]
    assert ends[0.0] > 0.1
    assert ends[10.0] < 1e-3


@pytest.mark.slow
def test_what_samples_cost():
    """At 1 ms 0.05 mm and 0.02 N, twice as much at 2 ms; V rises at times, by the square of it."""
    rises = {}
    for period, error in ((1e-3, 5.3e-5), (2e-3, 1.06e-4)):
        own = adaptive("two_link", adapted=LINK2)
        controller = AdaptiveController(own, period)
        record = roll(controller, 6.0, fixed_step(period / 2), period=period)
        assert late(record, 4.0)[0] == pytest.approx(error, rel=0.1)
        assert record["parameter_estimate"][-1] == pytest.approx([HEAVY], abs=1e-3)
        energy, _ = energies(own, record, [HEAVY])
        rises[period] = (energy - np.minimum.accumulate(energy)).max() / energy[0]
    assert 0.0 < rises[1e-3] < 5e-6
    assert rises[2e-3] == pytest.approx(4.0 * rises[1e-3], rel=0.2)


@pytest.mark.slow
def test_beside_the_observer_of_disturbances():
    """Of the same plant, sampled at 1 ms: the observer leaves six times the error or more."""
    model = arm("two_link").model
    dae = with_disturbance(model.dae, [signal.name for signal in model.links.velocity_signals])
    tracking = TrackingLaw(dae, poles(-4.0), measured_force=True)
    config = fixed_step(5e-4)
    errors = {}
    for rate in (10.0, 50.0):
        parts = {"sensor": ForceSensor(1, sample_period=1e-3), "observer": Observing(rate)}
        record = roll(TrackingController(tracking), 6.0, config, period=1e-3, **parts)
        errors[rate] = late(record, 4.0)
    assert errors[10.0][0] == pytest.approx(8.6e-4, rel=0.1)
    assert errors[50.0][0] == pytest.approx(3.4e-4, rel=0.1)


@pytest.mark.parametrize(("period", "tolerance"), [(0.0, 1e-7), (1e-3, 1e-12)])
@pytest.mark.parametrize("force_rate", [0.0, 10.0])
def test_rollouts_are_what_the_simulator_computes(force_rate, period, tolerance):
    controller = AdaptiveController(adaptive("two_link", force_rate), period)
    config = fixed_step(period) if period else error_controlled(1e-9)
    loop, context = loop_of(controller, period=period)
    controller.set_estimate(controller.GetMyMutableContextFromRoot(context), [11.0, 6.2])
    times = np.linspace(0.0, 0.5, 6)
    (rolled,) = rollout(loop, *start_values(loop, context), times, config=config, compiled=False)
    simulate(loop.diagram, context, 0.5, config)
    record = loop.record(context)
    assert rolled.failure is None
    assert set(rolled.record.signals) == set(record.signals)
    assert record["parameter_estimate"][0] == pytest.approx([11.0, 6.2])
    for name in record.signals:
        size = np.abs(record[name]).max(initial=1.0)
        assert_allclose(rolled.record[name][-1], record[name][-1], rtol=0, atol=tolerance * size)


def test_held_estimates_stay():
    controller = AdaptiveController(adaptive("two_link"))
    context = controller.CreateDefaultContext()
    controller.GetInputPort("estimated_state").FixValue(context, [1.2, -1.6, 0.1, 0.2])
    controller.GetInputPort("reference").FixValue(context, [0.3, 0.0, 0.0, 20.0])
    assert np.abs(controller.EvalTimeDerivatives(context).CopyToVector()).min() > 0.0
    controller.GetInputPort("hold").FixValue(context, [1.0])
    assert_allclose(controller.EvalTimeDerivatives(context).CopyToVector(), 0.0)


def pendulum(length):
    """M = m l^2, where l does not enter linearly."""
    q, v, one = ca.SX.sym("q"), ca.SX.sym("v"), ca.SX.sym("one")
    swing = LinkExpressions(
        q,
        v,
        2.0 * one**2,
        9.81 * one * ca.sin(q),
        parameters=(Parameter("length", np.array([length]), "m", symbol=one),),
    )
    return RobotModel(swing, [], [JointPositions([swing.position_signals[0].name])])


@pytest.mark.parametrize(
    ("model", "adapted", "why"),
    [
        (lambda: arm("two_link").model, {"wall.position": 1.0}, "constraints or outputs depend"),
        (lambda: arm("two_link").model, {"link9.mass": 1.0}, "no parameter 'link9.mass'; it has"),
        (lambda: arm("seven_joint").model, {"base.mass": 1.0}, "no force depends on it"),
        (lambda: arm("two_link").model, {}, "at least one"),
        (lambda: arm("two_link").model, {"link2.mass": -1.0}, "must be positive"),
        (lambda: actuated("two_link", "flexible").model, {"link2.mass": 1.0}, "not rigid"),
        (lambda: pendulum(0.5), {"length": 1.0}, "'length' cannot be adapted: .* not linear"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(model, adapted, why):
    with pytest.raises(ModelError, match=why):
        AdaptiveLaw(model(), adapted, 4.0, 8.0)


def test_friction_that_grows_with_the_force_is_refused():
    smooth = touching("two_link")
    wall = replace(smooth.constraints[0], friction=0.2, stiction_tolerance=0.1)
    rough = RobotModel(smooth.links, [wall], smooth.outputs, [1.2, -1.6])
    with pytest.raises(ModelError, match="have power"):
        AdaptiveLaw(rough, {"link2.mass": 1.0}, 4.0, 8.0)


def test_parts_that_break_the_proof_are_refused():
    controller = AdaptiveController(adaptive("two_link"))
    opening = UnilateralRobotPlant(arm("two_link").model, {"wall": 0.0})
    with pytest.raises(WiringError, match="contacts that stay closed, and wall"):
        controller.check_plant(opening)
    with pytest.raises(WiringError, match="observer: an adaptive law and an observer"):
        loop_of(controller, observer=Observing(5.0), period=1e-3)
    with pytest.raises(ModelError, match="sample_period"):
        AdaptiveController(adaptive("two_link"), -1.0)
    with pytest.raises(ModelError, match="sampled"):
        AdaptiveController(adaptive("two_link"), 0.01).ToAutoDiffXd()
