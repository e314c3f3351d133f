"""Scenarios whose outputs are internal forces, against MultibodyPlant and pencil and paper.

The truth is [[M, -J^T], [J, 0]] (v', lambda) = (tau - H, -Jdot v) with M, H and J of Drake.
"""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.multibody.tree import JacobianWrtVariable
from runs import run_scenario, scenario

HOURS = 120.0 * np.pi / 180.0 * np.arange(3)
CORNERS = 0.035 * np.column_stack([np.cos(HOURS), np.sin(HOURS), np.zeros(3)])
"""Where the fingers hold the puck, in its axes, m."""


@cache
def run(name, *settings):
    return run_scenario(scenario(name, *settings))


def drake(plant, q, v, contacts):
    """M, C v - g, and J and Jdot v of contacts: (frame, point), another one or None, and rows."""
    context, world = plant.CreateDefaultContext(), plant.world_frame()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    jacobian, bias = [], []
    for (frame, point), other, rows in contacts:
        total, own = 0.0, 0.0
        for sign, part in ((1.0, (frame, point)), (-1.0, other)):
            if part is not None:
                where = context, JacobianWrtVariable.kV, part[0], np.array(part[1]), world, world
                total = total + sign * plant.CalcJacobianTranslationalVelocity(*where)
                own = own + sign * plant.CalcBiasTranslationalAcceleration(*where)[:, 0]
        jacobian.append(total[rows])
        bias.append(own[rows])
    force = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
    return plant.CalcMassMatrix(context), force, np.vstack(jacobian), np.concatenate(bias), context


def motion(mass, force, jacobian, bias, torque):
    """(v', lambda)."""
    m = len(bias)
    matrix = np.block([[mass, -jacobian.T], [jacobian, np.zeros((m, m))]])
    return np.split(np.linalg.solve(matrix, [*(torque - force), *-bias]), [len(mass)])


# Three fingers: 9 joints, 6 positions of the puck, 9 forces of which 3 are internal.


def fingers(record, step):
    """(v', lambda) by Drake, lambda of the fingers on the puck, and the pose of the puck."""
    loop, _, _ = run("three_fingers", *FINE)
    plant = loop.plant.model.links.plant
    q, v = np.split(record["state"][step], 2)
    puck = plant.GetFrameByName("object")
    contacts = []
    for number, corner in enumerate(CORNERS, 1):
        tip = plant.GetFrameByName("tip", plant.GetModelInstanceByName(f"finger{number}"))
        contacts.append(((puck, corner), (tip, (0, 0, 0)), [0, 1, 2]))
    mass, force, jacobian, bias, context = drake(plant, q, v, contacts)
    pose = puck.CalcPoseInWorld(context)

    def solved(control):
        torque = plant.MakeActuationMatrix() @ control
        return motion(mass, force, jacobian, bias, torque)

    return solved, pose, jacobian, v


FINE = ("duration=1", "integrator.accuracy=1e-11")


def grasp_map(pose):
    """G of force and moment on the puck at its middle, from the three forces, shape (6, 9)."""
    levers = CORNERS @ pose.rotation().matrix().T
    crosses = [np.cross(lever, np.eye(3), axisb=0, axisc=0) for lever in levers]
    return np.vstack([np.tile(np.eye(3), 3), np.hstack(crosses)]), levers


@pytest.mark.slow
def test_forces_and_squeezes_of_the_fingers_are_those_of_drake():
    """Round-off of systems of 24 equations, with forces of some N and 1e3 rad/s^2 for each N."""
    _, _, record = run("three_fingers", *FINE)
    for step in range(0, len(record.time), 20):
        solved, pose, jacobian, v = fingers(record, step)
        _, force = solved(record["control"][step])
        assert_allclose(record["constraint_force"][step], force, atol=1e-9)
        assert_allclose(jacobian @ v, 0.0, atol=1e-9)
        _, levers = grasp_map(pose)
        force = force.reshape(3, 3)
        for column, (i, j) in enumerate([(0, 1), (1, 2), (2, 0)], 6):
            along = (levers[j] - levers[i]) / np.linalg.norm(levers[j] - levers[i])
            squeeze = along @ (force[i] - force[j]) / 2.0
            assert record["controlled_output"][step, column] == pytest.approx(squeeze, abs=1e-9)
            wanted = 2.0 + 0.5 * np.sin(3.0 * record.time[step])
            assert squeeze == pytest.approx(wanted, abs=1e-9)


# A biped with flexible joints: 4 joints, 3 positions of the trunk, 4 forces, 1 of them internal.


# Two arms with a free box: 14 joints, 6 positions of the box and 2 elbows, 12 forces, 6 internal.


@pytest.mark.slow
def test_forces_of_two_arms_on_a_free_box_are_those_of_drake():
    """Round-off of systems of 32 equations with forces of 60 N and torques of 100 N m."""
    loop, _, record = run("two_arms_free_box", *FINE)
    plant = loop.plant.model.links.plant
    context, box = plant.CreateDefaultContext(), plant.GetFrameByName("object")
    arms = [plant.GetModelInstanceByName(side) for side in ("left", "right")]
    for step in range(0, len(record.time), 10):
        q, v = np.split(record["state"][step], 2)
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        jacobian, bias = [], []
        for arm in arms:  # How the tool moves in the box, in the box's axes.
            moving = plant.GetFrameByName("tool", arm), np.zeros(3), box, box
            kind = JacobianWrtVariable.kV
            own = plant.CalcJacobianSpatialVelocity(context, kind, *moving)
            rate = plant.CalcBiasSpatialAcceleration(context, kind, *moving).get_coeffs()
            jacobian.append(np.roll(own, 3, axis=0))
            bias.append(np.roll(rate, 3))
        jacobian, bias = np.vstack(jacobian), np.concatenate(bias)
        force = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        torque = plant.MakeActuationMatrix() @ record["control"][step]
        _, found = motion(plant.CalcMassMatrix(context), force, jacobian, bias, torque)
        assert_allclose(record["constraint_force"][step], found, atol=1e-9)
        left, right = -found.reshape(2, 6)  # What the arms do to the box.
        internal = (left - right) / 2.0
        assert_allclose(record["controlled_output"][step, 8:], internal, atol=1e-9)
        assert left[0] > 10.0 > -10.0 > right[0]  # Both press.
