"""The check that a plant fits a task."""

from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import WiringError
from drake_dae.systems.control.contract import check_same_sizes
from drake_dae.systems.plants.contract import Plant


def check_plant_of_task(system: DaeSystem, sample_period: float, plant: Plant) -> None:
    """Refuses a plant that does not fit a task.

    Args:
        system: The system of the law in contact.
        sample_period: The sample period of the task, in s; 0 for none.
        plant: The plant.

    Raises:
        WiringError: The plant does not fit; the message has the reason.
    """
    check_same_sizes(plant.dae, system, "task", "the laws for the plant's robot")
    if plant.is_ideal:
        raise WiringError(
            "a task needs a contact that opens, and the constraints of this plant hold exactly: "
            "take a CompliantPlant or a ContactPlant (in a scenario: plant: !CompliantContact)"
        )
    if plant.time_step and not sample_period:
        raise WiringError(
            f"the plant steps by {plant.time_step:g} s, and its state jumps there: make the "
            f"controller with sample_period={plant.time_step:g} or a multiple of it"
        )
    if not sample_period:
        raise WiringError(
            "a compliant contact may be lost and regained at any time, and a task that reacts "
            "at once may switch without end: make the controller with a sample_period (in a "
            "scenario: sampling)"
        )
