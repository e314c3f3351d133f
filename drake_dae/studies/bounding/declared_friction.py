"""The distance of declared friction from the Painleve paradox, along a recorded run."""

import numpy as np

from drake_dae.dae.states.contact_margin import ContactMargin, ContactMargins
from drake_dae.dae.system.system import DaeSystem
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.records.record import Record

_STATES = 50
"""The number of states of a record that are examined."""


def declared_margin(loop: ClosedLoop, highest: Scenario, record: Record) -> ContactMargin | None:
    """Returns the margin of the highest declared friction along a run, in any sliding direction.

    Args:
        loop: The loop of the run.
        highest: The scenario with all unknown numbers at the high ends of their ranges.
        record: The record of the run.

    Returns:
        None without friction; also where the states of the law are not joint positions and
        velocities, as behind springs, or where the sliding velocities of a contact are not known.
    """
    structure, model = loop.controller.law.structure, loop.plant.robot("the margin of friction")
    system, joints = structure.system, model.links.q.numel()
    states = record["state"]
    friction = _friction(highest, [c.friction for c in system.contacts if c.friction], system)
    if not any(friction.values()) or {system.num_states, states.shape[1]} != {2 * joints}:
        return None
    if any(contact.friction and contact.sliding is None for contact in system.contacts):
        return None
    parameters = system.parameter_values.copy()
    for name, value in friction.items():
        parameters[system.parameter_slice(name)] = value
    margins = ContactMargins(system, structure.elimination.constraint_matrix)
    rows = np.unique(np.linspace(0, record.time.size - 1, _STATES).astype(int))
    velocities = slice(joints, 2 * joints)
    return margins.in_worst_directions(states[rows], parameters, velocities, record.time[rows])


def in_words(margin: ContactMargin) -> str:
    """The margin as a sentence."""
    critical = margin.critical_friction
    if not np.all(np.isfinite([*critical.values()])):
        return "Friction: in no direction of sliding a coefficient leads to the Painleve paradox."
    names = ", ".join(f"{name} {value:.3g}" for name, value in critical.items())
    when = f"nearest at t = {margin.time:.3g} s of the run in the middle of all ranges"
    if margin.is_paradoxical:
        return (
            "Friction: the Painleve paradox is within the declared range, in the worst direction "
            f"of sliding at {names}, {when}. There no force fits an ideal contact, and on a "
            "compliant one the force grows by itself."
        )
    return (
        f"Friction: with the highest declared one at least {margin.reserve:.2g} of A(x) is left "
        f"in the worst direction of sliding; the Painleve paradox is at {names}, {when}."
    )


def _friction(scenario: Scenario, names: list[str], system: DaeSystem) -> dict[str, float]:
    """The coefficient of friction of each contact of the plant of a scenario."""
    material = scenario.plant.material
    if material is not None and material.friction is not None:
        return dict.fromkeys(names, material.friction)
    values, own = system.parameter_values, scenario.plant_parameters
    of_law = {name: float(values[system.parameter_slice(name)].item()) for name in names}
    return {name: float(np.squeeze(own.get(name, of_law[name]))) for name in names}
