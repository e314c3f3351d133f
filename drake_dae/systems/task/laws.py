"""The two laws of a task belong together: those of one robot with and without a contact."""

from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.task.open_contact import output_of_force


def check_laws(law: TrackingLaw, free_law: TrackingLaw) -> tuple[int, int]:
    """Which output is force or distance, and which of the constraint forces is that force.

    Raises:
        ModelError: The laws are not those of one robot with and without the contact.
    """
    own, free = law.system, free_law.system
    names, others = (
        [signal.name for signal in system.constraint_input_signals] for system in (own, free)
    )
    gone = [name for name in names if name not in others]
    if len(gone) != 1 or (own.num_states, own.num_controls) != (
        free.num_states,
        free.num_controls,
    ):
        raise ModelError(
            f"a task needs the laws of one robot with and without a contact, as of its system and "
            f"of open_contact(system, force); these hold {', '.join(names) or 'nothing'} and "
            f"{', '.join(others) or 'nothing'}"
        )
    place, force = output_of_force(own, gone[0]), names.index(gone[0])
    distance = own.constraint_output_signals[force].name
    if free.output_signals[place].name != distance:
        raise ModelError(
            f"the free law must have the output '{distance}' where the law has '{gone[0]}'; make "
            "its system by open_contact"
        )
    for system, one in ((own, law), (free, free_law)):
        if one.exogenous_degrees:
            raise ModelError(
                f"{system.name}: the laws of a task take no exogenous signals; nothing may move"
            )
    kept = [i for i in range(own.num_outputs) if i != place]
    for i in kept:
        if law.degrees[i] != free_law.degrees[i]:
            raise ModelError(
                f"'{own.output_signals[i].name}' has degree {law.degrees[i]} in contact and "
                f"{free_law.degrees[i]} without, so that no reference leads from one to the other"
            )
    if free_law.degrees[place] < 2:
        raise ModelError(f"'{distance}' must have degree 2 or more, as where forces move it")
    return place, force
