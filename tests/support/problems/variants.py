"""A system with other expressions, or in other units."""

from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem


def changed(system: DaeSystem, **fields) -> DaeSystem:
    """The system with other expressions or labels."""
    return replace(system, **fields)


def in_other_units(system: DaeSystem, state, force, control, constraint, output) -> DaeSystem:
    """The same system with x, v, u, y, z measured in other units: factors per entry."""
    x = ca.SX.sym("x", system.num_states)

    def moved(expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, system.state, state * x)

    return replace(
        system,
        state=x,
        f=moved(system.f) / state,
        g=ca.mtimes(np.diag(1 / state), ca.mtimes(moved(system.g), np.diag(force))),
        h=ca.mtimes(np.diag(1 / state), ca.mtimes(moved(system.h), np.diag(control))),
        k=moved(system.k) / constraint,
        l=moved(system.l) / output,
        m=ca.mtimes(np.diag(1 / output), ca.mtimes(moved(system.m), np.diag(force))),
        nominal_state=system.nominal_state / state,
        state_scale=system.scale / state,
    )
