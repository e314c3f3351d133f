"""The balance of a robot with rigid joints, linear in some of its parameters."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, listed
from drake_dae.dae.system.signals import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import velocities_are_rates
from drake_dae.robots.model import RobotModel

_CLOSE = 1e-9
"""The relative difference below which two numbers count as equal."""


class ForceBalance:
    """M v' = F(q, v) + J^T lambda + B u with J v = 0, and its derivatives by theta.

    Args:
        model: The robot.
        adapted: The names of theta among its parameters.

    Attributes:
        q, v: Positions and velocities, symbols.
        mass: M, shape (nv, nv).
        positions: h_1, shape (k, 1).
        jacobian: J, shape (m, nv).
        rows: (dh_1/dq; J), square.
        shares: S of z_2 = S lambda, shape (m, m).
        inverse: B^-1, shape (nv, nv).
        theta: The adapted parameters, symbols.
        entries: Their indices among all parameters.
        signals: Names and units of theta.
        parameters: Name -> adapted parameter.

    Raises:
        ModelError: The robot or a parameter does not fit; the message has the reason.
    """

    def __init__(self, model: RobotModel, adapted: Sequence[str]) -> None:
        self.model, dae = model, model.dae
        _check_robot(model)
        links = model.links
        self.q, self.v = links.q, links.v
        nq, nv = self.q.numel(), self.v.numel()
        self.mass = dae.mass_matrix[nq:, nq:]
        self._force = dae.f[nq:, :]
        self.num_forces = dae.num_constraints
        self.num_positions = dae.num_outputs - self.num_forces
        self.positions = dae.l[: self.num_positions, :]
        self.jacobian = ca.jacobian(dae.k, self.q)
        self.rows = ca.vertcat(ca.jacobian(self.positions, self.q), self.jacobian)
        self.shares = dae.m[self.num_positions :, :]
        drive = dae.h[nq:, :]
        self.inverse = np.linalg.inv(np.array(ca.DM(drive).full()))
        known = {parameter.name: parameter for parameter in dae.parameters}
        if not adapted:
            raise ModelError(f"{model.name}: name at least one parameter to adapt")
        for name in adapted:
            if name not in known:
                raise ModelError(f"{model.name} has no parameter '{name}'; it has {listed(known)}")
        self.parameters: dict[str, Parameter] = {name: known[name] for name in adapted}
        self.theta = ca.vertcat(*[parameter.symbol for parameter in self.parameters.values()])
        places = [dae.parameter_slice(name) for name in adapted]
        self.entries = [i for place in places for i in range(place.start, place.stop)]
        self.signals = tuple(
            Signal(name if parameter.value.size == 1 else f"{name}[{i}]", parameter.unit)
            for name, parameter in self.parameters.items()
            for i in range(parameter.value.size)
        )
        a, s = ca.SX.sym("a", nv), ca.SX.sym("s", nv)
        self._arguments = ca.vertcat(a, s, self.theta)
        self._needed = ca.mtimes(self.mass, a) - self.coriolis(s) - self._force
        self._regressor = ca.jacobian(self._needed, self.theta)
        self._check_parameters(ca.vertcat(a, s))

    def coriolis(self, other: ca.SX) -> ca.SX:
        """C(q, v) s for a column of symbols s, by the Christoffel symbols of M.

        C s = (dM/dt s + d(M v)/dq s - (d(M v)/dq)^T s) / 2, so that x^T (M' - 2 C) x = 0.
        """
        q, v = self.q, self.v
        momentum = ca.mtimes(self.mass, v)
        return (
            ca.jtimes(ca.mtimes(self.mass, other), q, v)
            + ca.jtimes(momentum, q, other)
            - ca.jtimes(momentum, q, other, True)
        ) / 2.0

    def needed(self, acceleration: ca.SX, sliding: ca.SX, theta: ca.SX) -> ca.SX:
        """W(theta) = M a - C s - F, shape (nv, 1)."""
        arguments = ca.vertcat(acceleration, sliding, theta)
        return ca.substitute(self._needed, self._arguments, arguments)

    def regressor(self, acceleration: ca.SX, sliding: ca.SX, theta: ca.SX) -> ca.SX:
        """Y = dW/dtheta, shape (nv, k)."""
        arguments = ca.vertcat(acceleration, sliding, theta)
        return ca.substitute(self._regressor, self._arguments, arguments)

    def _check_parameters(self, motion: ca.SX) -> None:
        """Refuses parameters that W is not linear in, or that anything else depends on.

        Args:
            motion: The symbols of acceleration and sliding in W.
        """
        dae = self.model.dae
        others = ca.vertcat(dae.k, self.positions, ca.vec(self.shares))
        for name, parameter in self.parameters.items():
            refused = f"{self.model.name}: '{name}' cannot be adapted:"
            if ca.depends_on(others, parameter.symbol):
                raise ModelError(
                    f"{refused} constraints or outputs depend on it, not the balance of forces "
                    "alone"
                )
            if not ca.depends_on(self._needed, parameter.symbol):
                raise ModelError(f"{refused} no force depends on it")
        if not ca.depends_on(self._regressor, self.theta):
            return
        inputs = [dae.state, motion, dae.parameter_symbol]
        function = ca.Function("Y", inputs, [ca.densify(self._regressor)])
        random, values = np.random.default_rng(0), dae.parameter_values
        for name in self.parameters:
            for _ in range(4):
                state = dae.nominal_state + random.normal(size=dae.num_states)
                changed = values.copy()
                place = dae.parameter_slice(name)
                changed[place] += 1.0 + np.abs(changed[place])
                rates = random.normal(size=motion.numel())
                before, after = (_numbers(function(state, rates, p)) for p in (values, changed))
                if not np.allclose(before, after, rtol=0.0, atol=_CLOSE * np.abs(before).max()):
                    raise ModelError(
                        f"{self.model.name}: '{name}' cannot be adapted: the forces are not linear "
                        "in it, or not together with another adapted parameter"
                    )


def _numbers(value: ca.DM) -> FloatArray:
    return np.array(value.full())


def _check_robot(model: RobotModel) -> None:
    """Refuses a robot for which the proof does not hold."""
    dae, name = model.dae, model.name
    nq, nv = model.links.q.numel(), model.links.v.numel()
    reason = _why_not(model)
    if reason is None and dae.num_states == nq + nv:
        friction = ca.jacobian(dae.k, model.links.q).T - dae.g[nq:, :]
        inputs = [dae.state, dae.parameter_symbol]
        function = ca.Function("friction", inputs, [ca.densify(friction)])
        random = np.random.default_rng(0)
        for _ in range(4):
            state = dae.nominal_state + random.normal(size=dae.num_states)
            if np.any(np.abs(_numbers(function(state, dae.parameter_values))) > _CLOSE):
                reason = "its constraint forces have power: friction that grows with the force"
    if reason is not None:
        raise ModelError(f"{name}: an adaptive law does not fit: {reason}")


def _why_not(model: RobotModel) -> str | None:
    """The reason why an adaptive law does not fit a robot; None if it does."""
    dae, links = model.dae, model.links
    nv, m = links.v.numel(), dae.num_constraints
    if model.stages:
        return "its joints are not rigid; take the links alone, as link_side(model)"
    if not velocities_are_rates(links):
        return "the velocities of a body that is free to turn are not the rates of its coordinates"
    if dae.num_controls != nv:
        return f"it has {dae.num_controls} actuators for {nv} coordinates; each needs its own"
    drive = dae.h[links.q.numel() :, :]
    if not drive.is_constant():
        return "the effect of its actuators depends on the configuration"
    if dae.exogenous.moving:
        return "exogenous parameters are not supported"
    if dae.sharing is not None:
        return "its constraints are redundant"
    if ca.depends_on(dae.k, links.v):
        return "it has a constraint of velocities"
    if dae.num_outputs != nv:
        return "it needs as many outputs as coordinates"
    rows = dae.m[dae.num_outputs - m :, :]
    above = dae.m[: dae.num_outputs - m, :]
    if above.nnz() or rows.shape != (m, m) or dae.l[dae.num_outputs - m :, :].nnz():
        return "all of its constraint forces must be outputs, after the positions"
    return None
