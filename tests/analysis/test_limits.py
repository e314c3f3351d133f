"""Which limit references exceed most, and how much slower they must be to keep all limits."""

import casadi as ca
import numpy as np
import pytest
from arms import arm
from numpy.testing import assert_allclose
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

from drake_dae import ConstantReference, DaeSystem, SinusoidReference, ZeroDynamics, load_scenario
from drake_dae.analysis import LimitKind, SignalLimits, limits_along, robot_limits
from drake_dae.dae import Signal, find_structure
from drake_dae.running.judgement import FindingKind
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.judging import find_feasibility, judge_run
from drake_dae.systems.references import ReferenceGenerator

TIMES = np.linspace(0.0, 2.0, 401)
AMPLITUDE, FREQUENCY, FORCE = 0.2, 15.0, 20.0
CLOSE = 1e-5  # Ten times the accuracy of the bisection.


def judged(structure, limits, references, guess):
    reference = ReferenceGenerator(references, structure.layout.reference_degrees).reference
    motion = ZeroDynamics(structure.system, structure=structure).motion(reference, TIMES, guess)
    assert motion.ending is None
    return limits_along(structure, limits, reference, motion), motion


def on_the_wall(force=FORCE, **of_signals):
    """The two-link arm, with other limits of some signals."""
    found = arm("two_link")
    references = [SinusoidReference(0.3, AMPLITUDE, FREQUENCY), ConstantReference(force)]
    limits = robot_limits(found.model)
    for name, limit in of_signals.items():
        column = [signal.name for signal in limits.signals].index(name)
        limits.bounds[:, column] = -limit, limit
    start = [*found.model.configuration([0.3], guess=[1.2, -1.6]), 0.0, 0.0]
    return judged(found.structure, limits, references, start)


def required(motion):
    """Torques at rest, what the motion adds, and speeds, by MultibodyPlant's inverse dynamics."""
    plant = arm("two_link").plant
    tool, world = plant.GetFrameByName("tool"), plant.world_frame()
    context, none, still = plant.CreateDefaultContext(), MultibodyForces(plant), np.zeros(2)
    where = JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    rest, added = [], []
    for state, time in zip(motion.states, motion.times, strict=True):
        plant.SetPositions(context, state[:2])
        plant.SetVelocities(context, state[2:])
        jacobian = plant.CalcJacobianTranslationalVelocity(context, *where)[[0, 2]]
        bias = plant.CalcBiasTranslationalAcceleration(context, *where)[[0, 2], 0]
        wanted = [0.0, -AMPLITUDE * FREQUENCY**2 * np.sin(FREQUENCY * time)]
        added.append(
            plant.CalcInverseDynamics(context, np.linalg.solve(jacobian, wanted - bias), none)
        )
        # The wall pushes along -x with the commanded force.
        plant.SetVelocities(context, still)
        rest.append(jacobian.T @ [FORCE, 0.0] - plant.CalcGravityGeneralizedForces(context))
    return np.array(rest), np.array(added), motion.states[:, 2:]


def test_torques_and_speeds_of_an_arm_by_inverse_dynamics():
    """At the rate c the arm needs rest + c^2 added, which is linear in c^2."""
    allowed, speed = 60.0, 1.5
    found, motion = on_the_wall(joint2_motor=allowed, joint1_w=speed)
    rest, added, speeds = required(motion)
    limits = np.array([300.0, allowed])
    shares = np.hstack([np.abs(rest + added) / limits, np.abs(speeds) / [speed, 3.0]])
    row, column = np.unravel_index(np.argmax(shares), shares.shape)
    assert shares.max() > 1.3
    assert found.excess.signal.name == ["joint1_motor", "joint2_motor", "joint1_w"][column]
    assert_allclose(found.excess.time, TIMES[row])
    assert_allclose(found.excess.value / found.excess.limit, shares.max(), rtol=1e-9)
    squares = [((limits - s * rest) / np.abs(added))[s * added > 0.0].min() for s in (-1.0, 1.0)]
    slower = min(*np.sqrt(squares), speed / np.abs(speeds[:, 0]).max())
    assert_allclose(found.rate, slower, rtol=CLOSE)


def test_what_gravity_needs_at_rest_no_slower_motion_helps():
    found, motion = on_the_wall(joint1_motor=50.0)
    rest = required(motion)[0]
    assert found.rate is None
    assert np.abs(rest[:, 0]).min() > 50.0
    assert f"at rest joint1_motor has {np.abs(rest[:, 0]).max():.4g} N m" in found.remedy


LINK = """<link name="{name}"><inertial><mass value="{mass}"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{name}"/>
<axis xyz="{axis}"/><limit lower="-5" upper="5" effort="900" velocity="9"/></joint>"""
TRAY = """
robot: {file: tray.urdf, actuators: [tray_x, tray_z]}
constraints:
- !CoincidentPoints {name: grip, frame_a: tray_z, point_a: [0, 0, 0], frame_b: block_z,
    point_b: [0, 0, 0], axes: xz}
outputs: [!JointPositions {joints: [tray_x, tray_z]}]
forces: []
references: {tray_x: !Sinusoids {offset: 0, amplitudes: [0.2], frequencies: [5]}, tray_z: 0.5}
start: {positions: {tray_x: 0.0, tray_z: 0.5, block_x: 0.0, block_z: 0.5}}
judgement:
  friction_cones: [{normal: grip.fz, tangents: [grip.fx], limit: 0.3}]
duration: 2
write: {record: false, plots: false, animation: false}
"""


@pytest.fixture
def tray(tmp_path):
    """A tray that carries a block of 2 kg by friction; it moves by 0.2 m sin(5 t)."""
    links = "".join(
        LINK.format(
            name=f"{body}_{axis}", mass=mass if axis == "z" else 0.1, parent=parent, axis=to
        )
        for body, mass in (("tray", 5.0), ("block", 2.0))
        for axis, parent, to in (("x", "world", "1 0 0"), ("z", f"{body}_x", "0 0 1"))
    )
    (tmp_path / "tray.urdf").write_text(f'<robot name="tray"><link name="world"/>{links}</robot>')
    (tmp_path / "tray.yaml").write_text(TRAY)
    return tmp_path / "tray.yaml"


def test_a_friction_cone_of_a_scenario(tray):
    """m r'' needs friction: 2.1 kg of the block and its slide, and 2 kg on the tray press on it."""
    peak, allowed = 2.1 * 0.2 * 5.0**2, 0.3 * 2.0 * 9.81
    scenario = load_scenario(tray)
    found = find_feasibility(scenario).slowing
    assert "friction cone of grip.fz" in found.excess.signal.name
    assert_allclose(found.excess.value, peak - allowed, rtol=1e-5)
    assert_allclose(found.rate, np.sqrt(allowed / peak), rtol=1e-5)  # Times miss the peak by 1e-3.

    loop, context = build_scenario(scenario)
    simulate(loop.diagram, context, 2.0)
    run = judge_run(scenario, loop, context, loop.record(context))
    said = [one for one in run.findings if one.kind is FindingKind.LIMIT]
    assert [one.signal.name for one in said] == ["the friction cone of grip.fz"]
    assert "drake-dae analyze" in run.look_next[0]


def test_slower_references_are_not_examined_beside_zero_dynamics():
    """The place of a second mass on a spring does not follow from that of the first."""
    x, force = ca.SX.sym("x", 4), ca.SX.sym("force", 0)
    system = DaeSystem(
        state=x,
        f=ca.vertcat(x[2:], x[1] - x[0], x[0] - x[1] - x[3]),
        g=ca.SX(4, 0),
        h=ca.SX(ca.DM([0, 0, 1, 0])),
        k=ca.SX(0, 1),
        l=x[0],
        m=ca.SX(1, 0),
    )
    symbols, bounds = (ca.SX.sym("u"), force), np.array([[-1.0], [1.0]])
    kinds = [LimitKind.SPEED]
    limits = SignalLimits(system, [Signal("speed", "m/s")], kinds, x[2], bounds, symbols)
    references = [SinusoidReference(0.0, 1.0, 2.0)]
    found, _ = judged(find_structure(system), limits, references, np.zeros(4))
    assert_allclose(found.excess.value, 2.0, rtol=1e-3)
    assert found.rate is None
