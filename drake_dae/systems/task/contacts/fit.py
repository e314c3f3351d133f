"""The check that a plant fits a task."""

from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import WiringError
from drake_dae.systems.control.contract import check_same_sizes
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.task.contacts.open_contact import OpeningContact


def check_plant_of_task(
    system: DaeSystem, contact: OpeningContact, sample_period: float, plant: Plant
) -> None:
    """Refuses a plant that does not fit a task.

    Args:
        system: The system of the law in contact.
        contact: The contact that opens and closes.
        sample_period: The sample period of the task, in s; 0 for none.
        plant: The plant.

    Raises:
        WiringError: The plant does not fit; the message has the reason.
    """
    check_same_sizes(plant.dae, system, "task", "the laws for the plant's robot")
    if plant.time_step and not sample_period:
        raise WiringError(
            f"the plant steps by {plant.time_step:g} s, and its state jumps there: make the "
            f"controller with sample_period={plant.time_step:g} or a multiple of it"
        )
    if not (plant.time_step or plant.is_ideal or sample_period):
        raise WiringError(
            "a compliant contact may be lost and regained at any time, and a task that reacts "
            "at once may switch without end: make the controller with a sample_period (in a "
            "scenario: sampling)"
        )
    for name in (system.force_signals[i].name for i in contact.forces):
        if plant.contacts and name.split(".")[0] not in plant.contacts:
            raise WiringError(
                f"the contact with the force '{name}' does not open in this plant; contacts "
                f"that open: {', '.join(plant.contacts)}"
            )
