"""The largest forces by which a person pushes links."""

from collections.abc import Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.systems.plants.contract import Plant


def strongest_pushes(
    robots: Sequence[Plant],
    plants: Sequence[MultibodyPlant],
    context: Context,
    links: Sequence[str],
    rate: float,
) -> dict[str, float]:
    """Returns link -> the force of the strongest push on it, N.

    A law with poles at -p acts on a mass m like a spring of stiffness m p^2, and the effective mass
    at the link's origin is 1 / (J M^-1 J^T). So a force m p^2 d moves the link by d.

    Args:
        robots, plants: The robots, and Drake's own plants, that contain the links.
        context: The context of the diagram.
        links: The names of the links.
        rate: p^2 d, in m/s^2.
    """
    masses = dict[str, float]()
    for robot in robots:
        multibody = robot.robot("a bench").links.plant
        if multibody is not None:
            state = robot.state(robot.GetMyContextFromRoot(context))
            masses |= _effective_masses(multibody, state[: multibody.num_positions()], links)
    for plant in plants:
        positions = plant.GetPositions(plant.GetMyContextFromRoot(context))
        masses |= _effective_masses(plant, positions, links)
    return {name: mass * rate for name, mass in masses.items()}


def _effective_masses(
    plant: MultibodyPlant, positions: FloatArray, links: Sequence[str]
) -> dict[str, float]:
    """Returns link -> the effective mass at its origin, kg."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, positions)
    M, world, masses = plant.CalcMassMatrix(context), plant.world_frame(), dict[str, float]()
    for name in links:
        model, _, body = name.rpartition("::")
        if not plant.HasModelInstanceNamed(model):
            continue
        instance = plant.GetModelInstanceByName(model)
        if not plant.HasBodyNamed(body, instance):
            continue
        frame = plant.GetBodyByName(body, instance).body_frame()
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
        )
        # In the direction of the smallest mass; the bound covers links whose origin cannot move.
        mobility = float(np.linalg.eigvalsh(J @ np.linalg.solve(M, J.T))[-1])
        masses[name] = 1.0 / max(mobility, 1.0 / float(np.trace(M)))
    return masses
