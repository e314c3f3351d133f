"""A system with one contact open: its distances are outputs in place of its forces."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, unknown_name
from drake_dae.dae.structure.redundancy import with_constraints
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError


@dataclass(frozen=True)
class OpeningContact:
    """A contact of a task that opens and closes: a point, the points of a face, or a latch.

    A latch is a constraint whose forces have any sign, such as a weld: commands open and close it.

    Attributes:
        places: The indices of the outputs that are its forces, and its distances where it is open.
        forces: The indices of its constraint forces among all measured ones.
        main: The one of `places` that is its total force; of a latch the first one.
        is_latch: Whether it is a latch.
    """

    places: tuple[int, ...]
    forces: tuple[int, ...]
    main: int
    is_latch: bool = False

    @property
    def size(self) -> int:
        """The number of its points."""
        return len(self.forces)

    def total(self, forces: FloatArray) -> FloatArray:
        """The sum of its forces, along the last axis; of a latch the largest force or moment."""
        total: FloatArray = np.abs(forces).max(-1) if self.is_latch else forces.sum(-1)
        return total

    @property
    def others(self) -> list[int]:
        """The places besides `main`: moments, or further distances."""
        return [place for place in self.places if place != self.main]


def with_latch(system: DaeSystem, forces: Sequence[str], closed: Collection[str]) -> DaeSystem:
    """A system with some of its constraints, in which the forces of another latch are outputs:

        x' = f + g_c v_c + h u,    0 = k_c(x),    z = (v_i, z_2),

    where c are the constraints that are closed, and v_i the forces of the latch i among them. They
    are in the place of those outputs of the system that are constraint forces. The position outputs
    z_2 do not change. `open_contact(..., forces)` has the distances of the latch in these places.

    Args:
        system: The system with all constraints, and as many force outputs as the latch has forces.
        forces: The names of the forces of the latch.
        closed: The names of all forces of the constraints that are closed.

    Raises:
        ModelError: There are more or fewer force outputs than forces.
    """
    names = [signal.name for signal in system.constraint_input_signals]
    places = [j for j in range(system.num_outputs) if not system.m[j, :].is_zero()]
    if len(places) != len(forces):
        outputs = listed(system.output_signals[j].name for j in places)
        raise ModelError(
            f"{system.name}: the outputs that are forces are {outputs}, and a latch with the "
            f"forces {listed(forces)} needs as many in their place"
        )
    drift, matrix, signals = ca.SX(system.l), ca.SX(*system.m.shape), list(system.output_signals)
    for place, name in zip(places, forces, strict=True):
        i = names.index(name)
        drift[place], matrix[place, i] = 0, 1
        signals[place] = system.constraint_input_signals[i]
    led = replace(system, l=drift, m=matrix, output_signals=tuple(signals))
    return with_constraints(led, [row for row, name in enumerate(names) if name in closed])


@checked(ModelError)
def open_contact(
    system: DaeSystem, force: str | Sequence[str], *, is_latch: bool = False
) -> DaeSystem:
    """A system one of whose contacts is open:

        x' = f + g_o v_o + h u,    0 = k_o(x),    z = (l_o(x) + m_o(x) v_o, k_i(x)),

    where o are all constraints except those, i, with the named forces v_i: one, or those of the
    points of a face. These constraints do not hold, and the outputs that were their forces are
    their distances k_i(x). State, controls, parameters and the order of the outputs do not change,
    so that the laws of both systems can replace each other at any moment.

    Args:
        system: The system with the contact closed, `RobotModel.dae` for example.
        force: The name of the contact's force, "wall.force" for example, or those of a face or of a
            latch.
        is_latch: Whether it is a latch: then each of its forces is an output.

    Raises:
        ModelError: There is no such force; the outputs that depend on them are not as many, do not
            contain their sum, or depend on other forces; or constraints share their forces.
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
    contact = _contact(system, sorted({names.index(name) for name in forces}), is_latch)
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


def _contact(system: DaeSystem, forces: Sequence[int], is_latch: bool) -> OpeningContact:
    """The contact with some constraint forces.

    Raises:
        ModelError: The outputs that depend on them are not as many, do not contain their sum or, of
            a latch, are not each one of them; or depend on other forces.
    """
    names = [signal.name for signal in system.constraint_input_signals]
    outputs = listed(signal.name for signal in system.output_signals)
    others = [i for i in range(len(names)) if i not in forces]
    depending = [
        j for j in range(system.num_outputs) if any(not system.m[j, i].is_zero() for i in forces)
    ]
    fitting = [
        j
        for j in depending
        if system.l[j].is_zero() and all(system.m[j, i].is_zero() for i in others)
    ]
    if len(depending) == len(fitting) == len(forces):
        total = [j for j in fitting if all(system.m[j, i].is_one() for i in forces)]
        alone = [
            j
            for j, i in zip(fitting, forces, strict=True)
            if system.m[j, i].is_one() and sum(not system.m[j, k].is_zero() for k in forces) == 1
        ]
        if is_latch and alone == fitting:
            return OpeningContact(tuple(fitting), tuple(forces), fitting[0], True)
        if len(total) == 1 and not is_latch:
            return OpeningContact(tuple(fitting), tuple(forces), total[0])
    if is_latch:
        raise ModelError(
            f"{system.name}: each force of a latch must be one of the outputs by itself, in the "
            f"order {listed(names[i] for i in forces)}; the outputs are {outputs}"
        )
    if len(forces) == 1:
        raise ModelError(
            f"{system.name}: '{names[forces[0]]}' must be one of the outputs by itself, so that a "
            f"distance can be in its place where the contact is open; the outputs are {outputs}"
        )
    raise ModelError(
        f"{system.name}: the contact of {', '.join(names[i] for i in forces)} needs {len(forces)} "
        "outputs that depend on these forces alone, one of them their sum, so that distances can "
        f"be in their places where it is open, such as a FaceForces; the outputs are {outputs}"
    )


def opened_contact(
    law: TrackingLaw, free_law: TrackingLaw, is_latch: bool = False
) -> OpeningContact:
    """The contact that is closed in one law and open in the other.

    Args:
        law, free_law: The laws.
        is_latch: Whether it is a latch.

    Raises:
        ModelError: The laws are not for one robot with and without the contact.
    """
    closed, free = law.system, free_law.system
    names, others = (
        [signal.name for signal in system.constraint_input_signals] for system in (closed, free)
    )
    gone = [name for name in names if name not in others]
    if not gone or (closed.num_states, closed.num_controls) != (
        free.num_states,
        free.num_controls,
    ):
        raise ModelError(
            f"a task needs the laws of one robot with and without a contact, as of its system and "
            f"of open_contact(system, force); these hold {', '.join(names) or 'nothing'} and "
            f"{', '.join(others) or 'nothing'}"
        )
    if law.deflection is not None:
        raise ModelError(f"{closed.name}: a contact_stiffness is not for tasks; leave it out")
    contact = _contact(closed, [names.index(name) for name in gone], is_latch)
    for place, force in zip(contact.places, contact.forces, strict=True):
        distance = closed.constraint_output_signals[force].name
        if free.output_signals[place].name != distance:
            raise ModelError(
                f"the free law must have the output '{distance}' where the law has "
                f"'{closed.output_signals[place].name}'; make its system by open_contact"
            )
    if law.exogenous_degrees != free_law.exogenous_degrees:
        raise ModelError(
            f"{closed.name}: the law in contact needs {law.exogenous_degrees} derivatives of its "
            f"exogenous signals, as of an observer's estimates, the free law "
            f"{free_law.exogenous_degrees}; leave them, or the observer, out"
        )
    for i in range(closed.num_outputs):
        if i not in contact.places and law.degrees[i] != free_law.degrees[i]:
            raise ModelError(
                f"'{closed.output_signals[i].name}' has degree {law.degrees[i]} in contact and "
                f"{free_law.degrees[i]} without, so that no reference leads from one to the other"
            )
    for place in contact.places:
        if free_law.degrees[place] < 2:
            raise ModelError(
                f"'{free.output_signals[place].name}' must have degree 2 or more, as where forces "
                "move it"
            )
    return contact
