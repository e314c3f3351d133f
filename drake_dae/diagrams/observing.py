"""The wires of an observer, and the law that a scenario's observer feeds."""

from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_dae.errors import WiringError
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.observer import DisturbanceObserver
from drake_dae.systems.control.observer_rates import Observing
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.plants.contract import Plant


def add_observer(
    builder: DiagramBuilder,
    plant: Plant,
    controller: Controller,
    observing: Observing,
    state: OutputPort,
    sampling: Sampling | None,
    control: OutputPort,
    reference: OutputPort,
    limits: ControlLimits | None,
) -> DisturbanceObserver:
    """Adds the observer that feeds a controller's exogenous signals, but not yet its force.

    Args:
        builder: The builder of the diagram, with the other blocks in it.
        plant: The plant.
        controller: The controller.
        observing: The rates of the observer.
        state: The state input of the controller.
        sampling: The sampling of the hold after the controller.
        control: The control at the plant. An observer of a controller with `observed` ports takes
            these in place of both.
        reference: R(t).
        limits: The limits of the drives.

    Raises:
        WiringError: There is no sampling, or the law uses no measured force.
        ModelError: The law has no disturbance.
    """
    step = plant.time_step
    period = step if sampling is None else sampling.period
    if not period:
        raise WiringError(
            "an observer observes at samples: give the loop a sampling=Sampling(period), or a "
            "ContactPlant"
        )
    if plant.dae.num_constraints and not controller.law.measured_force:
        raise WiringError(
            "an observer needs the measured force; make the law with measured_force=True"
        )
    late = 0.0 if sampling is None else sampling.delay + step
    lag, delay = control_lag(plant, sampling), late + period / 2.0
    if controller.observed is not None:
        state, control = (controller.GetOutputPort(name) for name in controller.observed)
        lag = 0.5  # What is measured at both ends of a sample: their mean.
    observer = builder.AddSystem(DisturbanceObserver(controller.law, observing, period, lag, delay))
    builder.Connect(state, observer.GetInputPort("estimated_state"))
    builder.Connect(control, observer.GetInputPort("control"))
    builder.Connect(reference, observer.GetInputPort("reference"))
    builder.Connect(observer.GetOutputPort("exogenous"), controller.GetInputPort("exogenous"))
    if not plant.dae.num_constraints:
        none = plant.GetOutputPort("constraint_force")
        builder.Connect(none, observer.GetInputPort("measured_force"))
    if limits is not None:
        builder.Connect(limits.GetOutputPort("is_limited"), observer.GetInputPort("hold"))
    return observer


def control_lag(plant: Plant, sampling: Sampling | None) -> float:
    """The fraction of a sample for which a plant uses the previous control.

    Args:
        plant: The plant.
        sampling: The sampling of the hold after the controller.
    """
    step = plant.time_step
    period = step if sampling is None else sampling.period
    rest = 0.0 if sampling is None else sampling.rest
    return min((rest + step) / period, 1.0) if period else 0.0
