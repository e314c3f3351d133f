"""The contact of a task, and a system with it open: distances are outputs in place of forces."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import listed, unknown_name
from drake_dae.dae import DaeSystem, TrackingLaw
from drake_dae.dae.redundancy import with_constraints
from drake_dae.errors import ModelError

FREE, CONTACT = 0, 1
"""The indices of the two laws of a task."""


@dataclass(frozen=True)
class OpeningContact:
    """The contact of a task: one point, or several that open and close together."""

    places: tuple[int, ...]  # the outputs that are its forces, or its distances where it is open
    forces: tuple[int, ...]  # its constraint forces
    main: int  # the output that is the sum of its forces

    @property
    def size(self) -> int:
        return len(self.forces)

    @property
    def others(self) -> list[int]:
        """Differences of forces, or further distances."""
        return [place for place in self.places if place != self.main]


@checked(ModelError)
def open_contact(system: DaeSystem, force: str | Sequence[str]) -> DaeSystem:
    """A system one of whose contacts is open:

        x' = f + g_o v_o + h u,    0 = k_o(x),    z = (l_o(x) + m_o(x) v_o, k_i(x)),

    where o are all constraints except those, i, with the named forces: they do not hold, and the
    outputs that were their forces are their distances k_i(x).
    """
    forces = [force] if isinstance(force, str) else list(force)
    names = [signal.name for signal in system.constraint_input_signals]
    for name in forces:
        if name not in names:
            raise ModelError(f"{system.name}: {unknown_name('constraint force', name, names)}")
    if system.sharing is not None:
        raise ModelError(
            f"{system.name}: redundant constraints share their forces, and none of them opens; "
            "leave `compliances` out"
        )
    contact = _contact(system, sorted({names.index(name) for name in forces}))
    reduced = with_constraints(
        system, [row for row in range(len(names)) if row not in contact.forces]
    )
    drift, signals = ca.SX(reduced.l), list(reduced.output_signals)
    for j, i in zip(contact.places, contact.forces, strict=True):
        drift[j], signals[j] = system.k[i], system.constraint_output_signals[i]
    return replace(
        reduced,
        l=drift,
        output_signals=tuple(signals),
        implicit=reduced.implicit if reduced.num_constraints else None,
    )


def _contact(system: DaeSystem, forces: Sequence[int]) -> OpeningContact:
    """The contact with some constraint forces; raises as `open_contact` does."""
    m = ca.sparsify(system.m)
    others = [i for i in range(system.num_constraints) if i not in forces]
    places = [j for j in range(system.num_outputs) if m[j, forces].nnz()]
    total = [j for j in places if all(m[j, i].is_one() for i in forces)]
    is_alone = not m[places, others].nnz() and all(system.l[j].is_zero() for j in places)
    if is_alone and len(places) == len(forces) and len(total) == 1:
        return OpeningContact(tuple(places), tuple(forces), total[0])
    own = ", ".join(f"'{system.constraint_input_signals[i].name}'" for i in forces)
    raise ModelError(
        f"{system.name}: {own} must be outputs, one by itself, or of "
        "several points as many outputs of these alone, one of them their sum, such as "
        "ForceCombinations, so that distances can be in their places where the contact is open; "
        f"the outputs are {listed(signal.name for signal in system.output_signals)}"
    )


def opening_contact(law: TrackingLaw, free_law: TrackingLaw) -> OpeningContact:
    """The contact that is closed in one law and open in the other."""
    closed, free = law.system, free_law.system
    names, others = (
        [signal.name for signal in system.constraint_input_signals] for system in (closed, free)
    )
    gone = [name for name in names if name not in others]
    sizes = {(system.num_states, system.num_controls) for system in (closed, free)}
    if not gone or len(sizes) > 1:
        raise ModelError(
            f"a task needs the laws of one robot with and without a contact, as of its system and "
            f"of open_contact(system, force); these hold {', '.join(names) or 'nothing'} and "
            f"{', '.join(others) or 'nothing'}"
        )
    if law.deflection is not None:
        raise ModelError(f"{closed.name}: a contact_stiffness is not for tasks; leave it out")
    if law.exogenous_degrees != free_law.exogenous_degrees:
        raise ModelError(
            f"{closed.name}: the law in contact needs {law.exogenous_degrees} derivatives of its "
            f"exogenous signals, as of an observer's estimates, the free law "
            f"{free_law.exogenous_degrees}; leave them, or the observer, out"
        )
    contact = _contact(closed, [names.index(name) for name in gone])
    distances = dict(zip(contact.places, contact.forces, strict=True))
    for i, (degree, freed) in enumerate(zip(law.degrees, free_law.degrees, strict=True)):
        name, in_contact = free.output_signals[i].name, closed.output_signals[i].name
        if i in distances:
            distance = closed.constraint_output_signals[distances[i]].name
            if name != distance:
                raise ModelError(
                    f"the free law must have the output '{distance}' where the law has "
                    f"'{in_contact}'; make its system by open_contact"
                )
            if freed < 2:
                raise ModelError(f"'{name}' must have degree 2 or more, as where forces move it")
        elif degree != freed:
            raise ModelError(
                f"'{name}' has degree {degree} in contact and {freed} without, so that no "
                "reference leads from one to the other"
            )
    return contact
