"""Presliding by bristles, against closed forms, SciPy and MultibodyPlant."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, consistent_states, numbers, parse, touching
from numpy.testing import assert_allclose
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from scipy.integrate import solve_ivp

import drake_dae as dd
from drake_dae.errors import ModelError, ScenarioError, WiringError
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.robots.constraints.presliding import Bristles

MASS, GRAVITY, MU = 2.0, 9.81, 0.3
COULOMB = MU * MASS * GRAVITY
DELTA, RATIO, STRIBECK, TIME = 2e-5, 1.4, 0.01, 0.004
LUGRE = dd.Presliding(DELTA, RATIO, STRIBECK, TIME)


def steady(speed):
    """g of the Stribeck curve."""
    return 1.0 + (RATIO - 1.0) * np.exp(-((speed / STRIBECK) ** 2))


def bent(sliding, z):
    """z' and z + T(v) z', by NumPy."""
    speed = np.linalg.norm(sliding)
    rate = (sliding - speed / steady(speed) * z) / DELTA
    return rate, z + TIME * np.exp(-((TIME * speed / DELTA) ** 2)) * rate


def block(presliding=LUGRE, tilt=0.0, turned=0.0):
    """A block on a floor, with a force on it along x; its weight is tilted by an angle."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    place = ca.vertcat(q[0], 0.0, q[1])
    weight = MASS * GRAVITY * ca.SX([-np.sin(tilt), np.cos(tilt)])
    frames = {"bob": (ca.SX.eye(3), place)}
    links = dd.LinkExpressions(q, v, MASS * ca.SX.eye(2), weight, frames=frames)
    floor = dd.PointOnSurface(
        "bob",
        dd.Plane((0, 0, 0), (0, 0, 1)),
        name="floor",
        rpy=(0.0, 0.0, turned) if turned else None,
        friction=MU,
        presliding=presliding,
    )
    return dd.RobotModel(links, [floor], [dd.JointPositions(["q0"])], [0.0, 0.0])


def ideal(model):
    return dd.RobotPlant(model)


def compliant(model):
    return dd.CompliantPlant(model, dd.PointMaterial(0.0, stiffness=1e5, dissipation=50.0))


def pushed(plant, times, forces, samples, state=None, accuracy=1e-9):
    """The states at some times under a force along x, given at times with lines between them."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    along = np.vstack([forces, np.zeros_like(forces)])
    force = builder.AddSystem(TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, along)))
    builder.Connect(force.get_output_port(), plant.GetInputPort("control"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    if state is not None:
        plant.set_state(plant.GetMyMutableContextFromRoot(context), state)
    simulator = Simulator(diagram, context)
    ResetIntegratorFromFlags(simulator, "runge_kutta3", 0.05).set_target_accuracy(accuracy)
    states = []
    for time in samples:
        simulator.AdvanceTo(time)
        states.append(plant.state(plant.GetMyContextFromRoot(context)))
    return np.array(states)


def of_numbers(distance, ratio, stribeck, time):
    """Rate and traction of bristles in space as functions of (v, z)."""
    bristles = Bristles.of(["x", "y", "z"], [ca.SX(n) for n in (distance, ratio, stribeck, time)])
    v = ca.SX.sym("v", 3)
    outputs = [bristles.rate(v), bristles.traction(v)]
    return ca.Function("bristles", [v, bristles.state], outputs)


def test_a_slow_pull_bends_the_bristles_along_the_closed_form():
    """dz/dx = (1 - z / rho) / delta, so x = -rho delta ln(1 - z / rho) with z = F(t - T) / F_c.

    The stiffness at the start is F_c / delta. The pull takes 4 s: its speeds leave 1e-5 of static
    friction to the Stribeck curve, and T^2 F'' is zero.
    """
    times, static = np.array([0.0, 4.0]), RATIO * COULOMB
    samples = np.linspace(0.4, 4.0, 10)
    states = pushed(ideal(block()), times, np.array([0.0, 0.9 * static]), samples)
    force = 0.9 * static * (samples - TIME) / 4.0
    expected = -RATIO * DELTA * np.log(1.0 - force / static)
    assert_allclose(states[:, 0], expected, rtol=3e-4)
    assert force[0] / states[0, 0] == pytest.approx(COULOMB / DELTA, rel=0.06)


@pytest.mark.parametrize("plant_of", [ideal, pytest.param(compliant, marks=pytest.mark.slow)])
def test_a_slope_below_static_friction_holds_without_creep(plant_of):
    """In 100 s it moves by round-off; regularized friction creeps at 1e-3 m/s.

    A slope of 0.95 rho mu, so above dynamic friction. The compliant plant starts beside its
    equilibrium, by the round-off of its depth times k / F_c, and by the accuracy of 1e-9.
    """
    slope = 0.95 * RATIO * MU
    tilt = np.arctan(slope)
    model = block(tilt=tilt)
    rest = np.zeros(model.dae.num_states)
    rest[4] = slope / MU
    if plant_of is compliant:
        rest[1] = -MASS * GRAVITY * np.cos(tilt) / 1e5
    times, none = np.array([0.0, 100.0]), np.zeros(2)
    (after,) = pushed(plant_of(model), times, none, [100.0], rest)
    assert np.abs(after - rest).max() < (1e-12 if plant_of is ideal else 1e-8)
    if plant_of is ideal:
        creeping = block(None, tilt)
        (after,) = pushed(ideal(creeping), times, none, [1.0], rest[:4])
        assert after[0] > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "moves"), [(0.98, False), (1.02, True)])
def test_a_contact_breaks_away_at_static_friction(factor, moves):
    """A pull that rises slowly to rho F_c, less and more 2 %: bent by 1e-4 m, or 1e-2 m away.

    Once it slides, dynamic friction is below the pull by 0.4 of itself.
    """
    times = np.array([0.0, 2.0, 2.4])
    top = factor * RATIO * COULOMB
    (after,) = pushed(ideal(block()), times, np.array([0.0, top, top]), [2.4])
    assert (after[0] > 1e-2) == moves
    assert after[0] < 2e-4 or moves


@pytest.mark.parametrize("speed", [1e-4, 0.01, 0.02, 0.3])
def test_steady_sliding_is_on_the_stribeck_curve(speed):
    """With z = g(v) a pull of F_c g(v) keeps the speed, and z. Round-off of 1 / delta."""
    plant = ideal(block())
    context = plant.CreateDefaultContext()
    plant.set_state(context, [0.0, 0.0, speed, 0.0, steady(speed), 0.0, 0.0])
    plant.GetInputPort("control").FixValue(context, [COULOMB * steady(speed), 0.0])
    rate = plant.EvalTimeDerivatives(context).CopyToVector()
    assert_allclose(rate, [speed, 0.0, *np.zeros(5)], atol=1e-10 * speed / DELTA)


@pytest.mark.slow
def test_a_run_with_sticking_sliding_and_turning_is_scipys():
    """m x'' = f - F_c (z + T z') by Radau, to 1e-7 m on a way of centimetres."""
    times = np.linspace(0.0, 0.5, 26)
    forces = COULOMB * (0.2 + 1.7 * np.sin(14.0 * times))

    def motion(time, y):
        rate, traction = bent(y[1:2], y[2:])
        force = np.interp(time, times, forces)
        return [y[1], (force - COULOMB * traction[0]) / MASS, rate[0]]

    known = solve_ivp(
        motion, (0.0, 0.5), np.zeros(3), "Radau", times[1:], rtol=1e-9, atol=1e-12, max_step=2e-3
    )
    states = pushed(ideal(block()), times, forces, times[1:], accuracy=1e-8)
    assert np.ptp(known.y[0]) > 0.005
    assert known.y[1].min() < -0.01
    assert_allclose(states[:, 0], known.y[0], atol=1e-7)
    assert_allclose(states[:, 4], known.y[2], atol=1e-4)


def test_a_small_motion_to_and_fro_closes_a_hysteresis_loop():
    """Without a static excess and damping (Dahl), an amplitude A gives a closed loop with

    z = tanh(A / delta) at its ends and the loss 4 F_c (A - delta tanh(A / delta)) in each turn.
    """
    function = of_numbers(DELTA, 1.0, STRIBECK, 1e-9)
    amplitude, frequency = 1.3 * DELTA, 2.0 * np.pi

    def motion(time, y):
        v = np.array([amplitude * frequency * np.cos(frequency * time), 0.0, 0.0])
        rate, traction = function(v, [y[0], 0.0, 0.0])
        return [float(rate[0]), float(traction[0]) * v[0]]

    ends = [3.25, 4.25]  # Where x = A, after three turns.
    run = solve_ivp(motion, (0.0, 4.25), [0.0, 0.0], "LSODA", ends, rtol=1e-9, atol=1e-12)
    (z, again), (work, more) = run.y
    assert again == pytest.approx(z, abs=1e-7)
    assert z == pytest.approx(np.tanh(amplitude / DELTA), abs=1e-7)
    loss = 4.0 * (amplitude - DELTA * np.tanh(amplitude / DELTA))
    assert more - work == pytest.approx(loss, rel=1e-6)


def test_friction_is_passive_and_would_not_be_with_a_constant_damping():
    """Power >= rate of delta |z|^2 / 2 for any v and z, over four decades of speed."""
    random = np.random.default_rng(3)
    function, constant = of_numbers(DELTA, RATIO, STRIBECK, TIME), 0
    for _ in range(300):
        v = random.normal(size=3) * 10.0 ** random.uniform(-4.0, 0.0)
        z = random.normal(size=3)
        rate, traction = (value.full().ravel() for value in function(v, z))
        stored = DELTA * z @ rate
        assert traction @ v >= stored * (1.0 - 1e-9) - 1e-15
        constant += (z + TIME * rate) @ v < stored
        assert_allclose((rate, traction), bent(v, z), rtol=1e-9, atol=1e-12)
    assert constant > 10


@pytest.mark.parametrize("name", ["two_link", pytest.param("seven_joint", marks=pytest.mark.slow)])
def test_the_tool_of_an_arm_gets_the_force_of_its_bristles(name):
    """lambda and v' by NumPy with MultibodyPlant's numbers, as without presliding.

    A part of z along the normal has no effect. Numbers are of order 100.
    """
    smooth = touching(name)
    contact = dd.PointOnSurface(
        "tool", smooth.constraints[0].surface, name="wall", friction=MU, presliding=LUGRE
    )
    nominal = smooth.dae.nominal_state[: smooth.links.q.numel()]
    plant = ideal(dd.RobotModel(smooth.links, [contact], smooth.outputs, nominal, name))
    context, random = plant.CreateDefaultContext(), np.random.default_rng(1)
    count = smooth.links.v.numel()
    for state in consistent_states(name, 3):
        q, v = np.split(state, 2)
        n = numbers(name, q, v)
        across = n.output_jacobian[: 1 if name == "two_link" else 2]  # Of z; of y and z.
        z = random.uniform(-1.0, 1.0, 3)
        control = random.uniform(-30.0, 30.0, count)
        plant.GetInputPort("control").FixValue(context, control)
        plant.set_state(context, [*state, *z])
        sliding = across @ v
        rate, traction = bent(sliding, z[3 - len(across) :])
        G = n.constraint_jacobian[0] - MU * across.T @ traction
        left = np.block([[n.mass, -G[:, None]], [n.constraint_jacobian, np.zeros((1, 1))]])
        expected = np.linalg.solve(left, [*(control - n.bias), *-n.constraint_acceleration])
        found = plant.EvalTimeDerivatives(context).CopyToVector()
        assert_allclose(found[count : 2 * count], expected[:-1], rtol=1e-9, atol=1e-9)
        assert_allclose(found[-len(across) :], rate, rtol=1e-9, atol=1e-7)


def test_bristles_turn_with_their_surface():
    """The same motion and force on a floor that is turned about its normal, with z turned back."""
    turn, z, v = 0.8, np.array([0.3, -0.5, 0.0]), 0.02
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rates = []
    for angle, bristles in ((0.0, z), (turn, rotation.T @ z)):
        plant = ideal(block(turned=angle))
        context = plant.CreateDefaultContext()
        plant.GetInputPort("control").FixValue(context, [1.0, 0.0])
        plant.set_state(context, [0.1, 0.0, v, 0.0, *bristles])
        rates.append(plant.EvalTimeDerivatives(context).CopyToVector())
    rates[1][4:] = rotation @ rates[1][4:]
    assert_allclose(rates[1], rates[0], rtol=1e-12, atol=1e-9)


def test_bristles_of_joints_add_their_torque_and_their_states():
    """-F_c (z + T(v) z') - d v on each joint; round-off of torques of 100 N m."""
    known, coulomb, viscous = arm("two_link").model, np.array([3.0, 0.5]), 0.2
    friction = dd.JointFriction(["joint1", "joint2"], coulomb, viscous, presliding=LUGRE)
    model = dd.RobotModel.from_multibody(
        parse("two_link_arm"),
        known.constraints,
        known.outputs,
        [1.2, -1.6],
        known_forces=[friction],
    )
    names = [signal.name for signal in model.dae.state_signals[4:]]
    assert names == ["joint1.bristle", "joint2.bristle"]
    v, z = np.array([0.003, -0.2]), np.array([0.4, 0.9])
    values = []
    for robot, state in ((model, [*z]), (known, [])):
        f = ca.Function("f", [robot.dae.state, robot.dae.parameter_symbol], [robot.dae.f])
        value = f([1.2, -1.6, *v, *state], robot.dae.parameter_values)
        values.append(value.full().ravel())
    each = [bent(v[i : i + 1], z[i : i + 1]) for i in range(2)]
    rates, tractions = np.array(each)[..., 0].T
    assert_allclose(values[0][2:4] - values[1][2:], -coulomb * tractions - viscous * v, atol=1e-11)
    assert_allclose(values[0][4:], rates, rtol=1e-12)


@pytest.mark.slow
def test_a_law_that_knows_the_bristles_meets_its_prediction_from_rest():
    """Break-away included: the error of (30), (31) to the accuracy of 1e-8 of its integrator."""
    settings = [
        "constraints.0.friction=0.3",
        "constraints.0.presliding={distance: 1.0e-4, static_ratio: 1.3}",
    ]
    scenario = dd.load_scenario("two_link_wall", settings)
    loop, context = dd.build_scenario(scenario)
    dd.simulate(loop.diagram, context, 1.0, scenario.integrator)
    record = loop.record(context)
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max(axis=0)
    assert np.all(off < [1e-9, 1e-9])
    bristles = record["state"][:, -1]
    assert bristles[0] == 0.0
    assert np.abs(bristles).max() > 0.99


def test_encoders_show_copies_of_the_bristles():
    """The sensor's z is a second simulation of z, by the measured velocities at its samples."""
    settings = [
        "constraints.0.friction=0.3",
        "constraints.0.presliding={distance: 0.01}",
        "sampling={period: 0.001}",
        "encoders={position_noise: 1.0e-6, velocity_noise: 1.0e-4}",
        "duration=0.3",
    ]
    scenario = dd.load_scenario("two_link_wall", settings)
    loop, context = dd.build_scenario(scenario)
    dd.simulate(loop.diagram, context, 0.3, scenario.integrator)
    port = loop.encoders.output
    shown = port.Eval(loop.encoders.sensor.GetMyContextFromRoot(context))[-3:]
    true = loop.record(context)["state"][-1, -3:]
    assert not np.array_equal(shown, true)
    assert np.abs(true[2]) > 0.1
    assert_allclose(shown, true, atol=0.02)
    rise = "{start: [0], end: [0.1], limits: {speed: 0.1, acceleration: 1, jerk: 10}}"
    moving = [f"exogenous={{wall.position: [1.2, 0, !Line {rise}]}}"]
    with pytest.raises((ScenarioError, WiringError), match="whose surface moves"):
        dd.build_scenario(dd.load_scenario("two_link_wall", [*settings, *moving]))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"distance": 0.0}, "distance"),
        ({"distance": 1e-5, "static_ratio": 0.9}, "static_ratio"),
        ({"distance": 1e-5, "stribeck_speed": -1.0}, "stribeck_speed"),
        ({"distance": 1e-5, "damping_time": 0.0}, "damping_time"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(numbers, message):
    with pytest.raises(ModelError, match=message):
        dd.Presliding(**numbers)


@pytest.mark.slow
def test_what_cannot_be_combined_is_refused_in_one_sentence():
    wall = dd.Plane((1.2, 0, 0), (-1, 0, 0))
    with pytest.raises(ModelError, match="the coefficient of friction too"):
        dd.PointOnSurface("tool", wall, presliding=LUGRE)
    given = ["constraints.0.friction=0.3", "constraints.0.presliding={distance: 1.0e-4}"]
    for name, settings, message in (
        ("wall_point_contact", [], "!CompliantContact {time_step: 0}"),
        ("two_link_wall", ["plant=!CompliantContact {time_step: 0.001}"], "time_step: 0}"),
        ("two_link_flexible", [], "differentiates friction"),
    ):
        with pytest.raises(ScenarioError) as refused:
            dd.build_scenario(dd.load_scenario(name, [*given, *settings]))
        assert message in str(refused.value)


def test_the_force_that_is_drawn_has_the_traction_of_the_bristles():
    """-mu lambda (z + T z'), by NumPy; with (q, v) alone the bristles are at rest."""
    wrenches, velocity, z = ConstraintWrenches(block()), np.array([2e-3, 0.0]), np.array([0.4, 0.1])
    rigid = [0.0, 0.0, velocity[0], 0.0]
    for state, bristles in (([*rigid, *z, 0.0], z), (rigid, np.zeros(2))):
        drawn = wrenches(np.array(state), [5.0]).forces[0]
        assert_allclose(drawn, [*(-MU * 5.0 * bent(velocity, bristles)[1]), 5.0], rtol=1e-12)
