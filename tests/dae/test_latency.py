"""Damping under controls that act late, beside exact discretization, and in a sampled loop."""

import casadi as ca
import numpy as np
import pytest
from runs import roll, scenario
from scipy.linalg import expm

from drake_dae import DaeSystem, TrackingLaw, poles

INERTIA, DAMPING, PERIOD, POLE = 1e-3, 2.0, 1e-3, -10.0
LATENCY = 1.5 * PERIOD
"""A delay of one sample, and half of the time for which a control is held."""


def joint():
    """I v' + d v = u."""
    return DaeSystem.from_functions(
        ["q", "v"],
        f=lambda x, p: [x[1], -p.d / p.I * x[1]],
        h=lambda x, p: [[0.0], [1.0 / p.I]],
        l=lambda x, p: [x[0]],
        parameters={"I": INERTIA, "d": DAMPING},
    )


def sampled_error(latency, count=600):
    """The largest difference from the wanted decay, by the exact solution between samples."""
    law = TrackingLaw(joint(), poles(POLE), latency=latency)
    A = np.zeros((3, 3))
    A[0, 1], A[1, 1], A[1, 2] = 1.0, -DAMPING / INERTIA, 1.0 / INERTIA
    step = expm(PERIOD * A)[:2]
    state, on_the_way, errors = np.array([1.0, 0.0]), 0.0, []
    for _ in range(count):
        errors.append(state[0])
        (control,) = law.control(state, [0.0, 0.0, 0.0])
        state = step @ np.append(state, on_the_way)
        on_the_way = control
    times = PERIOD * np.arange(count)
    return np.abs(errors - (1.0 - POLE * times) * np.exp(POLE * times)).max()


def test_a_light_damped_joint_decays_as_designed_under_a_late_control():
    """T d / I = 3: without the latency the error is 27 per cent of its start off its decay.

    What is left, 0.8 per cent, is the delay of the feedback, some -POLE * LATENCY / 2.
    """
    assert sampled_error(0.0) > 0.25
    assert sampled_error(LATENCY) < 0.01
    # The latency is neither half nor twice as long.
    assert min(sampled_error(0.5 * LATENCY), sampled_error(2.0 * LATENCY)) > 0.03


def tool_with_drag():
    """Two joints of inertia I with a drag d of their tool along its path, whose gradient is J."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    tool = q[0] + q[1] + 0.1 * q[0] ** 2
    along = ca.jacobian(tool, q)
    return DaeSystem(
        state=ca.vertcat(q, v),
        mass_matrix=ca.diagcat(ca.SX.eye(2), INERTIA * ca.SX.eye(2)),
        f=ca.vertcat(v, -DAMPING * ca.mtimes([along.T, along, v])),
        g=ca.SX(4, 0),
        h=ca.DM([[0, 0], [0, 0], [1, 0], [0, 1]]),
        k=ca.SX(0, 1),
        l=q,
        m=ca.SX(2, 0),
    )


def test_damping_of_several_joints_at_once_is_a_matrix():
    """D = J^T d J, with J of the present position, as of a tool that slides with viscous friction.

    With the diagonal of D alone the direction that is not damped would be driven by 1 + T d / I = 4
    times as much as its errors need.
    """
    law = TrackingLaw(tool_with_drag(), poles(POLE), latency=LATENCY)
    position, speed = np.array([0.3, -0.2]), np.array([0.5, 0.4])
    control = law.control([*position, *speed], np.zeros(6))
    along = np.array([[1.0 + 0.2 * position[0], 1.0]])
    damping = DAMPING * along.T @ along
    wanted = -(POLE**2) * position + 2.0 * POLE * speed
    inertia = INERTIA * np.eye(2) + LATENCY * damping
    np.testing.assert_allclose(control, inertia @ wanted + damping @ speed, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_plant_that_steps_damps_by_the_speed_after_the_step():
    """The last joint, of 1e-3 kg m^2 or so with 100 N m s, from 10 mrad off, with poles at -10/s.

    The law acts at each step without a delay. What is left, 0.3 per cent of the start, is contact.
    """
    settings = (
        "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5, friction: 0.0}",
        "robot.known_forces=[!JointFriction {joints: [joint7], viscous: 100}]",
        "references={tool.y: 0, tool.z: 0.6, tool.z_axis: 0, joint3: 0, joint7: 0, wall.force: 20}",
        "start.errors={joint7: 0.01}",
        "law.gains=!Poles {all: [-10.0]}",
        "law.constraint_damping=!Poles {all: [-200.0]}",
        "duration=0.5",
    )

    def off(*sampling):
        loop, record = roll(scenario("wall_point_contact", *settings, *sampling))
        place = [s.name for s in loop.signals["controlled_output"]].index("joint7")
        difference = record["tracking_error"] - loop.predicted_error(record)
        return loop.controller.law.latency, np.abs(difference[:, place]).max()

    latency, without_sampling = off("sampling=null")
    assert latency == 0.001
    latency, sampled = off()
    assert latency == 0.002
    assert without_sampling < 1e-4
    assert sampled < 1e-4
