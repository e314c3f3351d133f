"""The number of outputs of a robot, and the choice among several controls."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.numbers import diagonal_parameter
from drake_dae.robots.links.links import Links


def check_outputs(
    name: str,
    links: Links,
    motors: Sequence[Signal],
    forces: int,
    positions: Sequence[Signal],
    is_chosen: bool,
) -> None:
    """Refuses a number of outputs that does not fit that of the actuators.

    Args:
        name: The robot's name in messages.
        links: The robot.
        motors: The actuators in joints that close loops.
        forces: The number of force outputs.
        positions: Names and units of the position outputs.
        is_chosen: Whether weights choose the control.

    Raises:
        ModelError: The numbers do not fit.
    """
    of_joints, count = len(links.actuator_signals), len(positions)
    rank = int(np.linalg.matrix_rank(links.actuation_matrix)) if of_joints else 0
    nu = of_joints + len(motors)
    if nu == 0 and count + forces:
        raise ModelError(
            f"{name}: there are no actuators, so no output can be controlled, but {count} "
            f"positions and {forces} constraint forces are outputs. To simulate it leave "
            "`positions` empty, and `forces` out; to steer it give joints actuators, by "
            "plant.AddJointActuator before Finalize or a <transmission> in its file"
        )
    if is_chosen:
        if not 0 < count + forces < nu:
            raise ModelError(
                f"{name}: control_weights choose among the controls of more actuators than "
                f"outputs, but there are {nu} actuators and {count + forces} outputs; leave them "
                "out"
            )
        return
    if rank < of_joints:
        actuators = ", ".join(signal.name for signal in links.actuator_signals)
        raise ModelError(
            f"{name}: the {of_joints} actuators {actuators} move the joints in only {rank} "
            "independent ways, for example if two drive one joint; leave one out, or give "
            "control_weights and fewer outputs"
        )
    if forces > nu:
        raise ModelError(
            f"{name}: {forces} constraint forces are outputs, but {nu} actuators can steer {nu} "
            "outputs; name in `forces` those to be steered ([] is none), remove constraints, or "
            "add actuators"
        )
    if count + forces and count + forces != nu:  # A robot that is only simulated needs no outputs.
        names = ", ".join(signal.name for signal in positions) or "none"
        fewer = ". For fewer, control_weights choose the control" if count + forces < nu else ""
        if forces and count + forces > nu:
            fewer = ". Name in `forces` those that shall be steered; [] is none"
        raise ModelError(
            f"{name}: {nu} actuators can steer {nu} outputs. The {forces} constraint forces "
            f"are outputs already, so {nu - forces} position outputs are needed; given are "
            f"{count} ({names}){fewer}"
        )


def control_choice(
    name: str, weights: ArrayLike | None, controls: Sequence[Signal]
) -> tuple[Parameter, ...]:
    """The parameters w and u_0 of the control with the least sum w_i (u_i - u_0i)^2.

    Args:
        name: The robot's name in messages.
        weights: w, one for all controls or one for each; None without a choice.
        controls: Names and units of u.

    Returns:
        "control_weights" and "free_control"; nothing without weights.

    Raises:
        ModelError: The weights do not fit.
    """
    if weights is None:
        return ()
    units = sorted({signal.unit for signal in controls})
    if np.ndim(weights) == 0 and len(units) > 1:
        raise ModelError(
            f"{name}: the controls are in {' and '.join(units)}, which one weight cannot compare; "
            "give each a weight, as 1 / limit^2"
        )
    nu = len(controls)
    chosen, _ = diagonal_parameter("control_weights", weights, nu, "", positive=True)
    return chosen, Parameter("free_control", np.zeros(nu), units[0] if len(units) == 1 else "")
