"""How hard links are pushed."""

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
    """Link -> the force of the strongest push on it, N.

    A law with poles at -p holds a mass m as a spring of stiffness m p^2 does, and the mass felt at
    the link's origin is 1 / (J M^-1 J^T). So a force m p^2 d moves it by d.

    Args:
        robots, plants: Robots, and plants of Drake's, that have these links.
        context: The context of the diagram.
        links: The links.
        rate: p^2 d, in m/s^2.
    """
    found = dict[str, float]()
    for robot in robots:
        drawn = robot.robot("a bench").links.plant
        if drawn is not None:
            state = robot.state(robot.GetMyContextFromRoot(context))
            found |= _felt(drawn, state[: drawn.num_positions()], links)
    for plant in plants:
        found |= _felt(plant, plant.GetPositions(plant.GetMyContextFromRoot(context)), links)
    return {name: mass * rate for name, mass in found.items()}


def _felt(drawn: MultibodyPlant, positions: FloatArray, links: Sequence[str]) -> dict[str, float]:
    """Link -> the mass that is felt at its origin, kg."""
    context = drawn.CreateDefaultContext()
    drawn.SetPositions(context, positions)
    mass, world, found = drawn.CalcMassMatrix(context), drawn.world_frame(), {}
    for name in links:
        instance, _, body = name.rpartition("::")
        if not drawn.HasModelInstanceNamed(instance):
            continue
        number = drawn.GetModelInstanceByName(instance)
        if not drawn.HasBodyNamed(body, number):
            continue
        frame = drawn.GetBodyByName(body, number).body_frame()
        J = drawn.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
        )
        # The direction in which it is lightest; a base that turns about its origin is not moved.
        lightest = float(np.linalg.eigvalsh(J @ np.linalg.solve(mass, J.T))[-1])
        found[name] = 1.0 / max(lightest, 1.0 / float(np.trace(mass)))
    return found
