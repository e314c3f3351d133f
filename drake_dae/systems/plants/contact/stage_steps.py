"""The steps of stages of actuation beside links that step as Drake's discrete MultibodyPlant."""

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.robots import RobotModel
from drake_dae.trace.factorization import PositiveDefiniteFactorization

_GROWTH = 1e-7  # allowed excess of the spectral radius over 1: round-off of motions without a force

_SHORTER = np.geomspace(1.0, 0.01, 300)[1:]  # of a too long step, tried for the message


def stages_after(model: RobotModel, time_step: float, control: ca.SX) -> ca.SX:
    """s after a step of the stages as an expression of x and u, shape (k, 1).

    The links get new velocities from the forces at t_n, and new positions from the new velocities.
    The stages do the same, from E s' = drift(q, v, s) + drive u: positions of shafts follow from
    their new velocities, and everything else from the values at t_n,

        E (s_(n+1) - s_n) = h (drift(q_n, v_n, s_n) + drive u_n),    but p_(n+1) = p_n + h p'_(n+1).

    For springs, links and shafts together this is the symplectic Euler method: an undamped
    oscillation of frequency w keeps its amplitude for w h < 2, with the frequency w_h of sin(w_h h
    / 2) = w h / 2 in place of w. An unstable step is refused: see `check_step`.
    """
    dae, size = model.dae, _num_link_states(model)
    rates = stage_rates(model, control)
    after = ca.vertcat(dae.state[:size], dae.state[size:] + time_step * rates)
    for position, velocity in _shafts(model).items():
        after[position] = dae.state[position] + time_step * after[velocity]
    return after[size:]


def stage_rates(model: RobotModel, control: ca.SX) -> ca.SX:
    """s' = E^-1 (drift(q, v, s) + drive u) as an expression of x and u, shape (k, 1)."""
    dae, size = model.dae, _num_link_states(model)
    driven = dae.f[size:] + ca.mtimes(dae.h[size:, :], control)
    # Stages do not share a mass with the links.
    return PositiveDefiniteFactorization(dae.mass_matrix[size:, size:]).solve(driven)


def check_step(model: RobotModel, time_step: float, parameters: FloatArray) -> None:
    """Refuses a step that is too long for the stages of a robot.

    About rest at the nominal state, one step multiplies small deviations of (q, v, s) by a matrix,
    whose eigenvalues must not be outside the unit circle. For springs without damping this means w
    h <= 2; for the electric part of a motor R h / L <= 2, and less if it oscillates with the
    inertia.
    """
    dae, links = model.dae, model.links
    assert model.joint_force is not None
    # C of x' = C x for links and stages without weight.
    B = ca.SX(ca.sparsify(ca.DM(links.actuation_matrix)))
    velocity = ca.mtimes(links.velocity_map, links.v)
    stages = dae.f[_num_link_states(model) :]
    forces = ca.vertcat(velocity, ca.mtimes(B, model.joint_force), stages)
    outputs = {"mass": dae.mass_matrix, "slope": ca.jacobian(forces, dae.state)}
    mass, force = dae.trace("linear motion", outputs, often=False)(dae.nominal_state, parameters)
    slope: FloatArray = np.asarray(np.linalg.solve(mass, force))
    positions = [*range(links.q.numel()), *_shafts(model)]
    moved = np.zeros_like(slope)
    moved[positions] = slope[positions]

    def growth(step: float) -> float:
        one = np.eye(len(slope))
        matrix = np.linalg.solve(one - step * moved, one + step * (slope - moved))
        return float(np.abs(np.linalg.eigvals(matrix)).max())

    if growth(time_step) <= 1.0 + _GROWTH:
        return
    fastest = float(np.abs(np.linalg.eigvals(slope)).max())
    shorter = [float(f"{part * time_step:.1e}") for part in _SHORTER]
    fitting = next((step for step in shorter if growth(step) <= 1.0 + _GROWTH), None)
    remedy = f", and so is one of {shorter[-1]:g} s; damp it, or take an ideal plant"
    if fitting is not None:
        remedy = f". Take {fitting:g} s or less; the law may keep its period with `sampling`"
    raise ModelError(
        f"a time_step of {time_step:g} s is too long for what drives the joints, which has motions "
        f"of {fastest:.3g} rad/s: each step would let one grow by {growth(time_step) - 1.0:.2g}"
        f"{remedy}"
    )


def _num_link_states(model: RobotModel) -> int:
    return int(model.links.q.numel() + model.links.v.numel())


def _shafts(model: RobotModel) -> dict[int, int]:
    """The index of each shaft's position in x -> that of its velocity."""
    velocities: dict[int, int] = {}
    for stage in model.stages:
        if stage.shaft is not None:
            columns = [
                ca.DM(ca.jacobian(symbols, model.dae.state)).full().argmax(axis=1).tolist()
                for symbols in stage.shaft
            ]
            velocities.update(zip(*columns, strict=True))
    return velocities
