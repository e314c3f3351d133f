"""The equations of motion, compared with the MultibodyPlant that they are read from."""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces

from drake_dae.dae import Parameter
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

TOLERANCE = 1e-10
"""Round-off gives 1e-14; any modelling error shows far above this."""


def compare_with_plant(
    plant: MultibodyPlant,
    q: ca.SX,
    v: ca.SX,
    parameters: Sequence[Parameter],
    terms: Mapping[str, ca.SX],
) -> None:
    """Compares each term with the plant's own value at three random states.

    The error of a term is its largest absolute difference, over its own largest entry or over that
    of M if that is larger: forces that cancel have no scale of their own.

    Args:
        plant: A finalized plant.
        q, v: Symbols of positions and velocities.
        parameters: The parameters of the terms, with the plant's own values.
        terms: Expressions under the names in `_plant_terms`.

    Raises:
        ModelError: A term differs, or the plant's own value is not finite.
    """
    symbols = ca.vertcat(ca.SX(0, 1), *[p.symbol for p in parameters])
    values = np.concatenate([np.zeros(0), *[p.value for p in parameters]])
    function = TracedFunction("comparison", {"q": q, "v": v, "parameters": symbols}, terms)
    random = np.random.default_rng(0)
    for _ in range(3):
        state = random.uniform(-1.0, 1.0, (2, v.numel()))
        ours = dict(zip(terms, function(*state, values), strict=True))
        theirs = _plant_terms(plant, *state)
        size = np.abs(theirs["mass matrix"]).max()
        if not size > 0.0:
            raise ModelError(
                "no link that moves has mass or inertia; give each of them an <inertial>, or weld "
                "it to one that has"
            )
        for name, other in theirs.items():
            if not np.all(np.isfinite(other)):
                raise ModelError(
                    f"the plant's own {name} is not finite at q = {state[0]}: a joint has no mass "
                    "to move; give each moving link mass and inertia, or weld it"
                )
            scale = max(np.abs(other).max(), 1.0 if name == "velocity map" else size)
            error = np.abs(ours[name] - other).max() / scale
            if not error <= TOLERANCE:
                raise ModelError(
                    f"{name} differs from the plant's own by {error:.1e} (relative) at "
                    f"q = {state[0]}, v = {state[1]}; this is an error in drake_dae, please "
                    "report the model"
                )


def _plant_terms(plant: MultibodyPlant, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The plant's own value of each term at positions and velocities."""
    context, forces = plant.CreateDefaultContext(), MultibodyForces(plant)
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    plant.CalcForceElementsContribution(context, forces)
    applied = plant.CalcGeneralizedForces(context, forces)
    inertial = plant.CalcBiasTerm(context)
    return {
        "mass matrix": plant.CalcMassMatrix(context),
        "Coriolis and centrifugal forces": inertial,
        "gravity": plant.CalcGravityGeneralizedForces(context),
        "force elements and damping": applied,
        "bias": inertial - applied,
        "velocity map": plant.MapVelocityToQDot(context, v),
    }
