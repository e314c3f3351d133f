"""Parameters that an observer estimates together, with their deviations."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from runs import scenario_model

from drake_dae import (
    DaePlant,
    DaeSystem,
    Sampling,
    SinusoidReference,
    TrackingLaw,
    build_scenario,
    load_scenario,
    make_closed_loop,
    poles,
    rollout,
    simulate,
)
from drake_dae.dae import DerivativeLayout, Observation, Parameter, find_structure, with_disturbance
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ScenarioError
from drake_dae.running import start_values
from drake_dae.scenario.shipped import FOLDER
from drake_dae.systems import Observing

T, MASS, VISCOUS = 0.002, 2.5, 0.7

PAYLOAD = (
    "robot.payloads=[{frame: tool, mass: 0.001}]",
    "bounds.payload.mass=[0.0005, 2]",
    "bounds.payload.center=[-0.2, 0.2]",
)
TILT = ("constraints.0.rpy=[0, 0, 0]", "bounds.wall.rpy=[-0.15, 0.15]")
JOINTS = [f"joint{i}" for i in range(1, 8)]
FRICTION = (
    f"robot.known_forces=[!JointFriction {{joints: [{', '.join(JOINTS)}]}}]",
    *(f"bounds.{joint}.coulomb=[0, 10]" for joint in JOINTS),
)
COULOMB = dict(zip(JOINTS, (3.0, 3.0, 2.0, 2.0, 1.0, 1.0, 0.5), strict=True))


def body() -> DaeSystem:
    """m q'' = u - d q', whose law believes in 1 kg and no friction."""
    x, none = ca.SX.sym("x", 2), ca.SX(0, 1)
    mass = Parameter("mass", 1.0, "kg", positive=True, bounds=(0.5, 5.0))
    viscous = Parameter("viscous", 0.0, "N s/m", bounds=(0.0, 2.0))
    return DaeSystem(
        x,
        ca.vertcat(x[1], -viscous.symbol * x[1]),
        ca.SX(2, 0),
        ca.vertcat(0, 1),
        none,
        x[0],
        ca.SX(1, 0),
        mass_matrix=ca.diagcat(1, mass.symbol),
        parameters=(mass, viscous),
        state_signals=("q", "v"),
    )


def moved(amplitude: float):
    """The record of the body on a sine, from its start on."""
    observed = with_disturbance(body(), ["v"], ["mass", "viscous"])
    law = TrackingLaw(observed, poles(-5.0))
    loop = make_closed_loop(
        DaePlant(body()),
        law,
        [SinusoidReference(0.0, [amplitude], [3.0])],
        LoopSettings(sampling=Sampling(T), observer=Observing(20.0)),
    )
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_parameter(own, "mass", MASS)
    loop.plant.set_parameter(own, "viscous", VISCOUS)
    simulate(loop.diagram, context, 6.0)
    return loop.record(context)


@pytest.mark.slow
def test_mass_and_viscous_friction_of_a_body_are_found_with_honest_deviations():
    """To 1 %, which is less than the deviations that are stated, and these are below 15 %."""
    record = moved(0.3)
    found, deviation = record["identified"][-1], record["identified_deviation"][-1]
    assert_allclose(found, [MASS, VISCOUS], rtol=0.01)
    assert np.all(np.abs(found - [MASS, VISCOUS]) < 2.0 * deviation)
    assert np.all(deviation < 0.15 * np.array([MASS, VISCOUS]))
    # The law knows them; a hold of T / 2 at a jerk of 8 m/s^3 and poles at -5 leaves 0.33 mm.
    assert np.abs(record["tracking_error"][-500:]).max() < 4e-4


def test_what_does_not_move_is_not_identified():
    """At rest the values stay, and so do the deviations of uniform numbers within the bounds."""
    record = moved(0.0)
    assert_allclose(record["identified"], [[1.0, 0.0]] * record.time.size, atol=1e-9)
    uniform = np.array([4.5, 2.0]) / 12.0**0.5
    assert_allclose(record["identified_deviation"][-1], uniform, rtol=1e-6)


@cache
def observed_arm():
    """The seven-joint arm with all kinds of parameters, and its observation."""
    settings = [*PAYLOAD, *TILT, *FRICTION, "plant=!CompliantContact {}"]
    model = scenario_model(load_scenario("wall_point_contact", settings))
    names = ["payload.mass", "payload.center", "wall.rpy", *(f"{j}.coulomb" for j in JOINTS)]
    velocities = [signal.name for signal in model.links.velocity_signals]
    system = with_disturbance(model.dae, velocities, ["wall.friction", *names])
    structure = find_structure(system)
    layout = DerivativeLayout(structure.output_degrees)
    return system, Observation.of(structure, layout), names


@pytest.mark.slow
def test_slopes_are_those_of_momentum_and_distance():
    """Central differences of steps of 1e-5, whose error is about 1e-9 of values of up to 10.

    The second derivatives of the distance are differences of its first ones.
    """
    system, observation, names = observed_arm()
    random = np.random.default_rng(1)
    x = system.nominal_state + 0.3 * random.standard_normal(system.num_states)
    u, v = random.standard_normal(7), np.array([20.0])
    values = system.parameter_values
    values[system.parameter_slice("payload.mass")] = 0.8
    slopes = observation.identified.slopes(x, u, v, values)
    found = [p.name for p in observation.identified.parameters]
    assert sorted(found) == sorted(names)
    places = [i for name in found for i in np.arange(values.size)[system.parameter_slice(name)]]
    k = ca.Function("k", [system.state, system.parameter_symbol], [system.k])
    bends = np.reshape(slopes[5], (len(places), len(places)), order="F")
    assert np.abs(bends).max() > 0.1
    for column, place in enumerate(places):
        ends, gap_slopes = [], []
        for step in (1e-5, -1e-5):
            shifted = values.copy()
            shifted[place] += step
            momentum = observation.momentum(x, u, v, shifted)[:3]
            ends.append([*momentum, k(ca.DM(x), ca.DM(shifted)).full().ravel()])
            gap_slopes.append(observation.identified.slopes(x, u, v, shifted)[4].copy())
        parts = [slopes[0], slopes[1], slopes[2], slopes[4]]
        for slope, high, low in zip(parts, *ends, strict=True):
            derived = np.reshape(slope, (len(high), -1), order="F")[:, column]
            assert_allclose(derived, (high - low) / 2e-5, atol=1e-7)
        assert_allclose(bends[:, column], np.ravel(gap_slopes[0] - gap_slopes[1]) / 2e-5, atol=1e-7)


def test_the_place_of_a_payload_is_that_of_a_body_in_a_multibody_plant():
    """M and gravity within 1e-11 of 10 kg m^2 and 60 N m."""
    system, _, _ = observed_arm()
    center, mass = np.array([0.05, -0.1, 0.15]), 1.3
    plant = MultibodyPlant(0.0)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(FOLDER / "models" / "package.xml"))
    parser.AddModelsFromUrl("package://drake_dae_models/seven_joint_arm.dmd.yaml")
    squares = center @ center - center**2
    unit = UnitInertia(*squares, *(-center[[0, 0, 1]] * center[[1, 2, 2]]))
    tool = plant.GetFrameByName("tool")
    load = plant.AddRigidBody(
        "load", tool.body().model_instance(), SpatialInertia(mass, center, unit)
    )
    plant.WeldFrames(tool, load.body_frame())
    plant.Finalize()
    q = np.random.default_rng(2).standard_normal(7)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    values = system.parameter_values
    values[system.parameter_slice("payload.mass")] = mass
    values[system.parameter_slice("payload.center")] = center
    arguments = [system.state, system.parameter_symbol]
    function = ca.Function("both", arguments, [system.mass_matrix[7:, 7:], system.f[7:]])
    M, f = function(ca.DM(np.concatenate([q, np.zeros(7)])), ca.DM(values))
    assert_allclose(M.full(), plant.CalcMassMatrix(context), atol=1e-11)
    gravity = plant.CalcGravityGeneralizedForces(context)
    assert_allclose(f.full().ravel(), gravity, atol=1e-11)


def rolled(duration: float, *settings: str):
    """The record of a rollout on points of 1e5 N/m with a friction of 0.3, unknown to the law."""
    compliant = "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5, friction: 0.3}"
    loop, context = build_scenario(load_scenario("wall_point_contact", [compliant, *settings]))
    start, parameters = start_values(loop, context)
    times = np.linspace(0.0, duration, round(1000 * duration) + 1)
    (run,) = rollout(loop, start, parameters, times)
    return loop, context, run.record


def rms(record, after: float):
    """The rms errors of position in mm and of the force in N after a time."""
    error = (record["controlled_output"] - record["desired_output"])[record.time > after]
    return 1e3 * np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))), np.sqrt(
        np.mean(error[:, -1] ** 2)
    )


KILOGRAM = (
    *PAYLOAD,
    "estimator.parameters=[payload.mass, payload.center]",
    "plant.parameters.payload.mass=1",
)
TILTED_AND_HEAVY = (
    "constraints.0.rpy=[0, 0, 0]",
    "plant.parameters.wall.rpy=[0, 0.07, -0.05]",
    "plant.payloads=[{frame: tool, mass: 1}]",
)
HEAVY_BESIDE = "plant.payloads=[{frame: tool, mass: 1, point: [0.05, 0.03, -0.1]}]"
FAST_FORCE = (
    "references.wall.force=!Sinusoids {offset: 25.0, amplitudes: [15.0], frequencies: [40.0]}"
)
JOINT_FRICTION = (
    FRICTION[0],
    *(f"plant.parameters.{joint}.coulomb={value}" for joint, value in COULOMB.items()),
    *(f"plant.parameters.{joint}.viscous=2.0" for joint in JOINTS),
)
ENCODERS = (
    "sensors.encoders={resolution: 1.0e-5}",
    "sensors.force={sample_period: 0.001, noise_deviation: 0.05}",
)
NOISY = (ENCODERS[0], "sensors.force={sample_period: 0.001, noise_deviation: 0.3}")


@pytest.mark.slow
@pytest.mark.parametrize("sensors", [(), ENCODERS], ids=["velocities", "encoders alone"])
def test_a_kilogram_more_is_found_and_compensated(sensors):
    """The figures of the book, mm and N after 3 s; a fifth of them without the estimate."""
    _, _, record = rolled(5.0, *KILOGRAM, *sensors)
    position, force = rms(record, 3.0)
    assert position < 0.03
    assert force < 0.05
    assert abs(record["friction"][-1, 0] - 0.3) < 0.03
    names = [signal.name for signal in record.signals["identified"].signals]
    place = names.index("payload.mass")
    deviation = record["identified_deviation"][-1, place]
    assert abs(record["identified"][-1, place] - 1.0) < 2.0 * deviation


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "position", "force", "true"),
    [
        (
            TILTED_AND_HEAVY,
            0.002,
            0.01,
            {
                "tool_load.mass": 1.0,
                "wall.rpy[1]": 0.07,
                "wall.rpy[2]": -0.05,
                "wall.friction": 0.3,
            },
        ),
        (
            (*TILTED_AND_HEAVY[:2], HEAVY_BESIDE, *ENCODERS),
            0.003,
            0.04,
            {
                "tool_load.mass": 1.0,
                "tool_load.center[0]": 0.05,
                "tool_load.center[1]": 0.03,
                "tool_load.center[2]": -0.1,
                "wall.rpy[1]": 0.07,
                "wall.friction": 0.3,
            },
        ),
        (ENCODERS, 0.004, 0.04, {"wall.friction": 0.3}),
        ((FAST_FORCE, *ENCODERS), 0.03, 1.3, {"wall.friction": 0.3}),
        (
            JOINT_FRICTION,
            0.01,
            0.15,
            {f"{joint}.coulomb": COULOMB[joint] for joint in ("joint1", "joint2", "joint4")}
            | {f"{joint}.viscous": 2.0 for joint in ("joint1", "joint2", "joint5")},
        ),
    ],
    ids=[
        "tilt and 1 kg",
        "tilt and 1 kg, encoders alone",
        "encoders alone",
        "fast force",
        "friction in joints",
    ],
)
def test_without_being_asked_it_finds_what_the_motion_excites(settings, position, force, true):
    """A hundredth and a tenth of 0.09 mm and 0.45 N, 0.07 mm and 0.77 N by friction alone.

    With encoders alone friction leaves 0.54 mm and 5.8 N; a force that changes by 15 N 6 times a
    second is followed to 0.55 mm and 15 N without its deflection, which is fed ahead; where nothing
    is unknown a filter each 10 ms takes noise for slopes and leaves 0.006 mm. Numbers are right to
    a tenth: Coulomb and viscous friction look alike in a part of the circle.
    """
    _, _, record = rolled(5.0, *settings)
    found = rms(record, 3.0)
    assert found[0] < position
    assert found[1] < force
    names = [signal.name for signal in record.signals["identified"].signals]
    values = dict(zip(names, record["identified"][-1], strict=True))
    for name, value in true.items():
        assert values[name] == pytest.approx(value, rel=0.1), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "message"),
    [
        ("wall_point_contact", "wall.position", "estimator.parameters: .*'wall.position'"),
        ("wall_point_contact", "link2.mas", "parameters: .*'link2.mass'"),
        ("two_link_wall", "link2.mass", r"estimator\.rate: "),  # It has no observer.
    ],
)
def test_estimates_that_are_not_possible_are_refused(name, parameter, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(load_scenario(name, [f"estimator.parameters=[{parameter}]"]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensors", "force", "friction"), [((), 0.1, 0.005), (NOISY, 0.3, 0.01)], ids=["", "encoders"]
)
def test_a_contact_breaks_away_for_the_first_time_without_a_swing(sensors, force, friction):
    """At most 0.1 mm and 0.1 N at a friction of 0.45 that the law takes for 0; 2.6 mm without.

    A rest of 1 s, then a line. With encoders alone, and 0.3 N of noise in the force, 0.97 mm.
    """
    limits = "{speed: 0.05, acceleration: 0.3}"
    line = f"!Line {{start: [0.0], end: [0.05], limits: {limits}, start_time: 1.0}}"
    settings = [
        f"references.tool.y={line}",
        "references.tool.z=0.7",
        "references.wall.force=!PointToPoint {start: [1], end: [20], start_time: 0, end_time: 0.8}",
        "plant.friction=0.45",
    ]
    _, _, record = rolled(2.0, *settings, *sensors)
    error = record["controlled_output"] - record["desired_output"]
    late = record.time > 0.9
    assert 1e3 * np.linalg.norm(error[late, :2], axis=1).max() < 0.1
    assert np.abs(error[late, -1]).max() < force
    assert abs(record["friction"][-1, 0] - 0.45) < friction


@pytest.mark.slow
def test_behind_springs_friction_does_not_jump():
    """The tracking law differentiates the estimates; with a jump it loses the contact at 0.7 s."""
    loop, context = build_scenario(
        load_scenario("wall_flexible_contact", ["plant.time_step=0.001"])
    )
    start, parameters = start_values(loop, context)
    (run,) = rollout(loop, start, parameters, np.linspace(0.0, 1.0, 1001))
    assert run.failure is None
    error = (run.record["controlled_output"] - run.record["desired_output"])[-1]
    assert 1e3 * np.linalg.norm(error[:2]) < 0.1
