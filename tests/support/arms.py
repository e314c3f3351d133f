"""The two shipped arms in contact, and what MultibodyPlant alone says about them."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from drake_dae import (
    AxisCoordinates,
    ClosedLoop,
    JointPositions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    TrackingLaw,
    build_scenario,
    load_scenario,
    poles,
)
from drake_dae.dae import GainDesign, Structure, find_structure
from drake_dae.robots import Stage
from drake_dae.scenario.shipped import FOLDER, find_scenario


class Arm(NamedTuple):
    plant: MultibodyPlant
    model: RobotModel
    structure: Structure


def parse(name: str) -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(FOLDER / "models" / "package.xml"))
    mounted = (FOLDER / "models" / f"{name}.dmd.yaml").exists()
    parser.AddModelsFromUrl(
        f"package://drake_dae_models/{name}.{'dmd.yaml' if mounted else 'urdf'}"
    )
    plant.Finalize()
    return plant


def touching(name: str, actuation: Sequence[Stage] = ()) -> RobotModel:
    """ "two_link" on the wall x = 1.2, or "seven_joint" on the wall x = 0.7."""
    if name == "two_link":
        wall, outputs = 1.2, [PointCoordinates("tool", "z")]
        positions = [1.2, -1.6]
    else:
        wall = 0.7
        outputs = [
            PointCoordinates("tool", "yz"),
            AxisCoordinates("tool", "z", "yz"),
            JointPositions(["joint3", "joint7"]),
        ]
        positions = [0.0, -0.1938, 0.0, -1.936, 0.0, 0.559, 0.0]
    contact = PointOnSurface("tool", Plane((wall, 0, 0), (-1, 0, 0)), name="wall")
    plant = parse(f"{name}_arm")
    return RobotModel.from_multibody(plant, [contact], outputs, positions, name, actuation)


@cache
def arm(name: str) -> Arm:
    """The arm with rigid joints on its wall; see `touching`."""
    model = touching(name)
    return Arm(model.links.plant, model, find_structure(model.dae))


def law(name: str, gains: GainDesign | None = None) -> TrackingLaw:
    return TrackingLaw(arm(name).model.dae, gains or poles(-4.0), structure=arm(name).structure)


def fixed_step(step: float = 1e-3, scheme: str = "runge_kutta5") -> SimulatorConfig:
    return SimulatorConfig(integration_scheme=scheme, max_step_size=step, use_error_control=False)


def error_controlled(accuracy: float) -> SimulatorConfig:
    return SimulatorConfig(
        integration_scheme="runge_kutta5", accuracy=accuracy, use_error_control=True
    )


def shipped(name: str) -> tuple[ClosedLoop, Context]:
    return build_scenario(load_scenario(find_scenario(name)))


def consistent_states(name: str, count: int, seed: int = 0) -> np.ndarray:
    """Random states on N* around the working configuration, moving at about 1 rad/s."""
    found, random = arm(name), np.random.default_rng(seed)
    nominal = found.model.dae.nominal_state
    spread = np.repeat([0.2, 1.0], nominal.size // 2)
    guesses = nominal + spread * random.standard_normal((count, nominal.size))
    return np.array([found.structure.manifold.project(guess) for guess in guesses])


class Numbers(NamedTuple):
    """M, H, J, P and the bias accelerations, from MultibodyPlant alone."""

    mass: np.ndarray
    bias: np.ndarray
    constraint_jacobian: np.ndarray
    output_jacobian: np.ndarray
    constraint_acceleration: np.ndarray
    outputs: np.ndarray


def numbers(name: str, q: np.ndarray, v: np.ndarray) -> Numbers:
    """Evaluates MultibodyPlant; only the two walls and output sets of `arm` are written here."""
    plant = arm(name).plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    world, tool = plant.world_frame(), plant.GetFrameByName("tool")
    jacobian = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    )
    acceleration = plant.CalcBiasSpatialAcceleration(
        context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    ).translational()
    pose = tool.CalcPoseInWorld(context)
    normal = np.array([-1.0, 0.0, 0.0])
    position, axis = pose.translation(), pose.rotation().matrix()[:, 2]
    if name == "two_link":
        output_jacobian, outputs = jacobian[[5]], position[[2]]
    else:
        turning = -_cross(axis) @ jacobian[:3]
        output_jacobian = np.vstack([jacobian[[4, 5]], turning[[1, 2]], np.eye(7)[[2, 6]]])
        outputs = np.concatenate([position[[1, 2]], axis[[1, 2]], q[[2, 6]]])
    return Numbers(
        plant.CalcMassMatrix(context),
        plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context),
        normal[None] @ jacobian[3:],
        output_jacobian,
        normal[None] @ acceleration,
        outputs,
    )


def _cross(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def tool_at_start(scenario):
    """The pose of the seven-joint arm's tool at the start of a scenario, by MultibodyPlant."""
    plant = parse("seven_joint_arm")
    context = plant.CreateDefaultContext()
    for name, value in scenario.start.positions.items():
        plant.GetJointByName(name).set_angle(context, value)
    return plant.GetFrameByName("tool").CalcPoseInWorld(context)
