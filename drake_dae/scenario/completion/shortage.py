"""The reasons why outputs cannot be completed: dependent force outputs, or too few positions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_dae.errors import ScenarioError
from drake_dae.scenario.completion.choice import INDEPENDENT, first_independent
from drake_dae.scenario.completion.postures import Posture

_ZERO = 1e-6
"""A singular value of S(q) below this, relative to the largest, is zero."""


def check_independent(names: Sequence[str], posture: Posture) -> None:
    """Checks that the force outputs z_2 = S lambda are independent.

    Args:
        names: Their names.
        posture: A configuration on the constraints.

    Raises:
        ScenarioError: They depend on each other; the message names them.
    """
    if not len(posture.forces):
        return
    left, values, _ = np.linalg.svd(posture.forces)
    rank = int(np.count_nonzero(values > _ZERO * values[0]))
    if rank == len(names):
        return
    weights = np.linalg.norm(left[:, rank:], axis=1)
    dependent = [name for name, weight in zip(names, weights, strict=True) if weight > _ZERO]
    text = (
        f"{', '.join(dependent)} depend on each other at the start: of {len(names)} force outputs "
        f"only {rank} are independent. Leave out {dependent[-1]}"
    )
    if rank < len(names) - 1:
        text += f" and {len(names) - rank - 1} more"
    text += (
        "; what squeezes between contacts of one plane cannot do is a force across it, as a "
        "!ForceCombination of the forces that are normal to it"
    )
    raise ScenarioError(("forces", text))


def why_none(
    posture: Posture,
    rows: Sequence[int],
    joints: Sequence[int],
    missing: int,
    given: int,
    forces: Sequence[str],
) -> tuple[str, str] | None:
    """The key and text of the problem if some of the missing outputs must be forces.

    Args:
        posture: The start.
        rows: The rows of positions that are outputs already.
        joints: The rows of positions of joints.
        missing: The number of missing outputs.
        given: The number of position outputs in the scenario.
        forces: The names of the constraint forces.

    Returns:
        The key and the text; None if there are enough independent positions.
    """
    ways = len(posture.mass) - int(np.linalg.matrix_rank(posture.constraints, 1e-9))
    lacking = given + missing - ways
    if lacking <= 0:
        return None
    chosen = [*rows, *first_independent(posture, rows, joints, ways - len(rows))]
    named: list[str] = []
    for place, name in enumerate(forces):
        row = np.eye(len(forces))[[place]]
        more = replace(posture, forces=np.vstack([posture.forces.reshape(-1, len(forces)), row]))
        if len(named) < lacking and more.independence(chosen) > INDEPENDENT:
            posture, named = more, [*named, name]
    text = (
        f"{given + missing} outputs more are needed, one for each actuator that is left, but "
        f"on its constraints the robot moves in {ways} ways: at most {ways} can be positions, and "
        f"{lacking} more must be forces"
    )
    if len(named) == lacking:
        text += f". Name them under forces, for example {', '.join(named)}"
    else:
        text += "; fewer are independent there, so leave actuators out by robot.actuators"
    return "forces", text
