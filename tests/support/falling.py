"""Bodies that fall onto a floor, written down by hand: a ball, a box, and a block that rocks."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

from drake_dae import LinkExpressions, Plane, PointOnSurface, RobotModel, UnilateralRobotPlant
from drake_dae.dae.system.signals import Signal
from drake_dae.robots.constraints.constraint import Application, Constraint

GRAVITY = 9.81
FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))

# Half of a box's width and height in m, its mass, and its moment of inertia.
HALF, HEIGHT, MASS = 0.2, 0.5, 2.0
INERTIA = MASS * (HALF**2 + HEIGHT**2) / 3.0

CORNERS = {
    "left": (-HALF, 0.0, -HEIGHT),
    "right": (HALF, 0.0, -HEIGHT),
    "top_left": (-HALF, 0.0, HEIGHT),
    "top_right": (HALF, 0.0, HEIGHT),
}


def ball_model(mass=1.0, exogenous=()):
    """A ball above a floor, z its height; nothing drives it."""
    z, v = ca.SX.sym("z"), ca.SX.sym("v")
    links = LinkExpressions(
        z,
        v,
        ca.SX(mass),
        ca.SX(mass * GRAVITY),
        {"ball": ca.vertcat(0, 0, z)},
        actuation_matrix=np.zeros((1, 0)),
    )
    floor = PointOnSurface("ball", FLOOR, name="floor")
    return RobotModel(links, [floor], [], forces=[], exogenous=exogenous)


def ball(restitution, mass=1.0):
    """A ball that falls onto a floor."""
    return UnilateralRobotPlant(ball_model(mass), {"floor": restitution})


def mass_point(plates, restitution=0.0, rpy=None, exogenous=()):
    """A mass point of 2 kg in space over plates, each of which it touches from the face alone."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    links = LinkExpressions(
        q,
        v,
        MASS * ca.SX.eye(3),
        ca.SX([0.0, 0.0, MASS * GRAVITY]),
        {"point": q},
        actuation_matrix=np.zeros((3, 0)),
    )
    faces = [PointOnSurface("point", plate, name=name, rpy=rpy) for name, plate in plates.items()]
    model = RobotModel(links, faces, [], forces=[], exogenous=exogenous)
    return UnilateralRobotPlant(model, dict.fromkeys(plates, restitution))


def planar_box(constraints, driven=True):
    """A box in the x-z plane: x, z, and its angle about y; pushed along x and turned."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, s), ca.horzcat(0, 1, 0), ca.horzcat(-s, 0, c))
    pushed = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    links = LinkExpressions(
        q,
        v,
        ca.diag(ca.SX([MASS, MASS, INERTIA])),
        ca.SX([0.0, MASS * GRAVITY, 0.0]),
        {"box": (turned, ca.vertcat(q[0], 0, q[1]))},
        actuation_matrix=pushed if driven else pushed[:, :0],
        default_positions=np.array([0.0, HEIGHT, 0.0]),
    )
    return RobotModel(links, constraints, [], forces=[])


def box(contacts: Mapping[str, float], driven=True, floor=FLOOR):
    """A box some of whose corners touch a smooth floor."""
    feet = [PointOnSurface("box", floor, CORNERS[name], name=name) for name in contacts]
    return UnilateralRobotPlant(planar_box(feet, driven), contacts)


@dataclass(frozen=True)
class StickingCorner(Constraint):
    """A corner of the box stays on the floor and does not slide: z = 0, x' = 0."""

    name: str
    is_unilateral: ClassVar = (True, False)

    @property
    def force_signals(self):
        return (Signal(f"{self.name}.normal", "N"), Signal(f"{self.name}.tangential", "N"))

    @property
    def residual_signals(self):
        return (Signal(f"{self.name}.gap", "m"), Signal(f"{self.name}.slip", "m/s"))

    def residual(self, frames):
        return frames.position("box", CORNERS[self.name])[2]

    def rate(self, kinematics):
        velocity = kinematics.velocity("box", CORNERS[self.name])
        return ca.vertcat(velocity[2], velocity[0])

    def applications(self, kinematics):
        axes = ca.SX(np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 0.0]]))
        corner = kinematics.position("box", CORNERS[self.name])
        return (Application(corner, axes, ca.SX(3, 2), "box"),)


def rocking_block():
    """Housner's block: its feet neither bounce nor slide."""
    model = planar_box([StickingCorner("left"), StickingCorner("right")], driven=False)
    return UnilateralRobotPlant(model, {"left": 0.0, "right": 0.0}, settling_time=5e-3)


def standing_on_right(angle):
    """The box at rest on its right foot, at x = HALF, turned by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    x, z = HALF - c * HALF + s * HEIGHT, s * HALF + c * HEIGHT
    return np.array([x, z, angle, 0.0, 0.0, 0.0])


def simulator_of(
    plant, state, step=0.01, accuracy=1e-8, scheme="runge_kutta5", control: np.ndarray | None = None
):
    """Fixed steps, and events to a hundredth of `accuracy` in steps; zero controls by default."""
    simulator = Simulator(plant)
    ResetIntegratorFromFlags(simulator, scheme, step)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    context = simulator.get_mutable_context()
    controls = plant.GetInputPort("control").size()
    if controls:
        given = np.zeros(controls) if control is None else control
        plant.GetInputPort("control").FixValue(context, given)
    plant.set_state(context, state)
    context.SetAccuracy(accuracy)
    simulator.Initialize()
    return simulator, context
