"""The contact problem of crocoddyl on the same task (`pip install crocoddyl==3.2.1 "pin<4.1"`).

Its action models eliminate the contact force at each node, with Baumgarte's feedback against drift.
The limits of the force and the end are penalties, since its solver has no such constraints.
"""

import time
from typing import Any

import crocoddyl
import numpy as np
import pinocchio
from task import DURATION, LEAST, MOST, WALL, Plan

import drake_dae as dd

NODES = 100

END, FORCE = 1e8, 1e3
"""Weights of the end, and of the force beyond its limits."""

BAUMGARTE = np.array([0.0, 50.0])
"""Of the position, in 1/s^2, and of the velocity, in 1/s, as in crocoddyl's examples."""

AWAY = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
"""A rotation whose last column is the normal of the wall, -x."""


def plan(model: dd.RobotModel, first: np.ndarray, last: np.ndarray) -> Plan:
    """From rest to rest with the least integral of u'u."""
    arm = pinocchio.buildModelFromUrdf(str(dd.shipped_model("two_link_arm.urdf")))
    # The tool is a frame of Drake's in the URDF.
    tip = pinocchio.SE3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    body = arm.getFrameId("link2")
    kind = pinocchio.FrameType.OP_FRAME
    arm.addFrame(pinocchio.Frame("tool", arm.getJointId("joint2"), body, tip, kind))
    begun, step = time.perf_counter(), DURATION / NODES
    running = crocoddyl.IntegratedActionModelEuler(dynamics(arm, last, is_end=False), step)
    final = crocoddyl.IntegratedActionModelEuler(dynamics(arm, last, is_end=True), 0.0)
    problem = crocoddyl.ShootingProblem(first, NODES * [running], final)
    solver = crocoddyl.SolverFDDP(problem)
    guess = [first + (last - first) * k / NODES for k in range(NODES + 1)]
    converged = solver.solve(guess, problem.quasiStatic(guess[:-1]), 1000, False)
    seconds = time.perf_counter() - begun
    states, controls = np.array(solver.xs), np.array(solver.us)
    forces = [float(each.differential.pinocchio.lambda_c[0]) for each in problem.runningDatas]
    times = np.linspace(0.0, DURATION, NODES + 1)

    def at(t: float) -> int:
        return min(int(np.searchsorted(times, t, side="right")), NODES) - 1

    return Plan(
        f"crocoddyl, FDDP, {NODES} nodes of Euler",
        seconds,
        lambda t: np.array([np.interp(t, times, column) for column in states.T]),
        lambda t: controls[at(t)],
        lambda t: forces[at(t)],
        times,
        bool(converged),
    )


def dynamics(arm: Any, last: np.ndarray, is_end: bool) -> Any:
    """The arm with its tool on the wall, and the costs of a node."""
    state = crocoddyl.StateMultibody(arm)
    drives = crocoddyl.ActuationModelFull(state)
    tool, aligned = arm.getFrameId("tool"), pinocchio.LOCAL_WORLD_ALIGNED
    contacts = crocoddyl.ContactModelMultiple(state, drives.nu)
    wall = crocoddyl.ContactModel1D(state, tool, -WALL, aligned, AWAY, drives.nu, BAUMGARTE)
    contacts.addContact("wall", wall)
    costs = crocoddyl.CostModelSum(state, drives.nu)

    def add(name: str, activation: Any, residual: Any, weight: float) -> None:
        costs.addCost(name, crocoddyl.CostModelResidual(state, activation, residual), weight)

    if is_end:
        end = crocoddyl.ResidualModelState(state, last, drives.nu)
        add("end", crocoddyl.ActivationModelQuad(4), end, END)
    else:
        effort = crocoddyl.ResidualModelControl(state, drives.nu)
        # It takes the half of squares.
        add("effort", crocoddyl.ActivationModelQuad(drives.nu), effort, 2.0)
        bounds = crocoddyl.ActivationBounds(np.array([LEAST]), np.array([MOST]))
        force = crocoddyl.ResidualModelContactForce(
            state, tool, pinocchio.Force.Zero(), 1, drives.nu
        )
        add("force", crocoddyl.ActivationModelQuadraticBarrier(bounds), force, FORCE)
    return crocoddyl.DifferentialActionModelContactFwdDynamics(
        state, drives, contacts, costs, 0.0, True
    )
