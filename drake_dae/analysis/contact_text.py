"""The distance of friction from the Painleve paradox, as text and data."""

from typing import Any

import casadi as ca
import numpy as np

from drake_dae.analysis.findings import Findings
from drake_dae.analysis.tables import named_values
from drake_dae.dae.states.contact_margin import ContactMargin


def contact_margin_in_words(findings: Findings, where: str, margin: ContactMargin) -> str:
    """Returns a sentence on the fraction of A(x) left by friction, and critical coefficients."""
    critical = ", ".join(f"{name} {value:.4g}" for name, value in margin.critical_friction.items())
    if not np.all(np.isfinite([*margin.critical_friction.values()])):
        return f"Friction: {where} no coefficient leads to the Painleve paradox."
    when = "" if margin.time is None else f"t = {margin.time:.4g} s, "
    constrained, system = findings.constraint_structure, findings.system
    used = None
    if constrained is not None:
        matrix = ca.vec(constrained.elimination.constraint_matrix)
        used = ca.which_depends(matrix, system.state, 1, False)
    place = named_values(system.state_signals, margin.state, used)
    return (
        f"Friction: {where} at least {margin.reserve:.3g} of A(x) is left; the Painleve paradox is "
        f"at {critical}, nearest at {when}{place}."
    )


def contact_margin_as_dict(margin: ContactMargin | None) -> dict[str, Any] | None:
    """Returns the margin as plain numbers; a coefficient without a critical value is None."""
    if margin is None:
        return None
    return {
        "reserve": margin.reserve,
        "critical_friction": {
            name: value if np.isfinite(value) else None
            for name, value in margin.critical_friction.items()
        },
        "state": margin.state.tolist(),
        "time": margin.time,
    }
