"""Whether expressions of a system have the same values."""

import casadi as ca
import numpy as np

from drake_dae.dae.system.system import DaeSystem


def agree(system: DaeSystem, first: ca.SX, second: ca.SX, *unknowns: ca.SX) -> bool:
    """Returns whether two expressions agree at random states around the nominal state.

    The parameters are varied as well: expressions that agree at their defaults alone are different.
    """
    symbols = [system.state, *unknowns, system.parameter_symbol]
    function = ca.Function("both", symbols, [ca.densify(first), ca.densify(second)])
    random, p = np.random.default_rng(0), system.parameter_values
    deviation = system.nominal_spread
    finite = 0
    for spread in (0.0, 0.1, 0.1):
        x = system.nominal_state + deviation * random.standard_normal(system.num_states)
        numbers = [random.standard_normal(u.numel()) for u in unknowns]
        changed = p + spread * random.standard_normal(p.size) * np.where(p == 0.0, 1.0, p)
        a, b = (v.full() for v in function(x, *numbers, changed))
        if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
            continue  # Out of the domain of one of the functions.
        finite += 1
        # By columns: constraints may have very different units.
        size = np.abs(a).max(axis=0, initial=0.0) + np.abs(b).max(axis=0, initial=0.0)
        if not np.all(np.abs(a - b) <= 1e-9 * np.abs(b) + 1e-11 * size):
            return False
    return finite > 0
