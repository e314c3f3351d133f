"""A system with one contact open: its distance is an output in place of its force."""

from dataclasses import replace

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import listed, unknown_name
from drake_dae.dae.beyond.disturbance import DISTURBANCE
from drake_dae.dae.structure.redundancy import with_constraints
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError


@checked(ModelError)
def open_contact(system: DaeSystem, force: str) -> DaeSystem:
    """A system one of whose contacts is open:

        x' = f + g_o v_o + h u,    0 = k_o(x),    z = (l_o(x) + m_o(x) v_o, k_i(x)),

    where o are all constraints except the one, i, with the named force v_i. This constraint does
    not hold, and the output that was its force is its distance k_i(x). State, controls, parameters
    and the order of the outputs do not change, so that the laws of both systems can replace each
    other at any moment.

    Args:
        system: The system with the contact closed, `RobotModel.dae` for example.
        force: The name of the contact's force, "wall.force" for example.

    Raises:
        ModelError: There is no such force; it is not one of the outputs by itself; or constraints
            share their forces.
    """
    names = [signal.name for signal in system.constraint_input_signals]
    if force not in names:
        raise ModelError(f"{system.name}: {unknown_name('constraint force', force, names)}")
    if system.sharing is not None:
        raise ModelError(
            f"{system.name}: redundant constraints share their forces, and none of them opens; "
            "leave `compliances` out"
        )
    i, j = names.index(force), output_of_force(system, force)
    reduced = with_constraints(system, [row for row in range(len(names)) if row != i])
    drift, signals = ca.SX(reduced.l), list(reduced.output_signals)
    drift[j], signals[j] = system.k[i], system.constraint_output_signals[i]
    return replace(
        reduced,
        l=drift,
        output_signals=tuple(signals),
        implicit=reduced.implicit if reduced.num_constraints else None,
    )


def output_of_force(system: DaeSystem, force: str) -> int:
    """The index of the output that is a constraint force, on which no other output depends.

    Raises:
        ModelError: There is none, or others depend on it.
    """
    i = [signal.name for signal in system.constraint_input_signals].index(force)
    depending = [j for j in range(system.num_outputs) if not system.m[j, i].is_zero()]
    chosen = [
        j
        for j in depending
        if system.l[j].is_zero()
        and system.m[j, i].is_one()
        and ca.sparsify(system.m[j, :]).nnz() == 1
    ]
    if len(chosen) != 1 or depending != chosen:
        outputs = listed(signal.name for signal in system.output_signals)
        raise ModelError(
            f"{system.name}: '{force}' must be one of the outputs by itself, so that a distance "
            f"can be in its place where the contact is open; the outputs are {outputs}"
        )
    return chosen[0]


def opened_contact(law: TrackingLaw, free_law: TrackingLaw) -> tuple[int, int]:
    """The index of the output that is force or distance, and that of the constraint force.

    Raises:
        ModelError: The laws are not for one robot with and without the contact.
    """
    closed, free = law.system, free_law.system
    names, others = (
        [signal.name for signal in system.constraint_input_signals] for system in (closed, free)
    )
    gone = [name for name in names if name not in others]
    if len(gone) != 1 or (closed.num_states, closed.num_controls) != (
        free.num_states,
        free.num_controls,
    ):
        raise ModelError(
            f"a task needs the laws of one robot with and without a contact, as of its system and "
            f"of open_contact(system, force); these hold {', '.join(names) or 'nothing'} and "
            f"{', '.join(others) or 'nothing'}"
        )
    place, force = output_of_force(closed, gone[0]), names.index(gone[0])
    if law.deflection is not None:
        raise ModelError(f"{closed.name}: a contact_stiffness is not for tasks; leave it out")
    distance = closed.constraint_output_signals[force].name
    if free.output_signals[place].name != distance:
        raise ModelError(
            f"the free law must have the output '{distance}' where the law has '{gone[0]}'; make "
            "its system by open_contact"
        )
    moving = [p.name for p in closed.exogenous.moving]
    if moving and DISTURBANCE not in moving:
        raise ModelError(
            f"{closed.name}: the laws of a task take only the exogenous signals of an observer; "
            f"'{moving[0]}' may not move"
        )
    if law.exogenous_degrees != free_law.exogenous_degrees:
        raise ModelError(
            f"{closed.name}: the law in contact needs {law.exogenous_degrees} derivatives of an "
            f"observer's estimates, the free law {free_law.exogenous_degrees}; leave the observer "
            "out"
        )
    for i in range(closed.num_outputs):
        if i != place and law.degrees[i] != free_law.degrees[i]:
            raise ModelError(
                f"'{closed.output_signals[i].name}' has degree {law.degrees[i]} in contact and "
                f"{free_law.degrees[i]} without, so that no reference leads from one to the other"
            )
    if free_law.degrees[place] < 2:
        raise ModelError(f"'{distance}' must have degree 2 or more, as where forces move it")
    return place, force
