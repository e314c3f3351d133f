"""The wires of an observer, and the law that a scenario's observer feeds."""

from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_dae.dae.disturbance import with_disturbance
from drake_dae.dae.structure.structure import Structure, find_structure
from drake_dae.diagrams.contact_plant import ContactPlant
from drake_dae.diagrams.keys import at
from drake_dae.diagrams.scenario import Scenario
from drake_dae.errors import ModelError, WiringError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.controller import TrackingController
from drake_dae.systems.limits import ControlLimits
from drake_dae.systems.observer import DisturbanceObserver
from drake_dae.systems.observer_rates import Observing
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.sampling import Sampling


def add_observer(
    builder: DiagramBuilder,
    plant: DaePlant | ContactPlant,
    controller: TrackingController,
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
        observing: How the observer observes.
        state: The state that the controller gets.
        sampling: That of the hold behind the controller.
        control: What arrives at the plant.
        reference: R(t).
        limits: The limits of the drives.

    Raises:
        WiringError: There are no samples to observe at, or the law takes no measured force.
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
    rest, late = (0.0, 0.0) if sampling is None else (sampling.rest, sampling.delay + step)
    lag, delay = min((rest + step) / period, 1.0), late + period / 2.0
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


def observed_structure(scenario: Scenario, model: RobotModel, structure: Structure) -> Structure:
    """The structure of what a scenario's law is for: with a disturbance, where it is observed.

    Raises:
        ScenarioError: The observer does not fit; the message names its key.
    """
    observer = scenario.observer
    if observer is None:
        return structure
    with at("observer"):
        if scenario.exogenous:
            raise ModelError("not beside exogenous signals, whose port it feeds")
        rubbing = {c.name: c.friction_parameter for c in model.constraints if c.friction_parameter}
        for name in observer.friction:
            if name not in rubbing:
                raise ModelError(
                    f"friction: '{name}' is no constraint with friction; give it friction: 0.0 "
                    f"where it is not known. With friction: {', '.join(rubbing) or 'none'}"
                )
        velocities = [signal.name for signal in model.links.velocity_signals]
        frictions = [rubbing[name] for name in observer.friction]
        return find_structure(with_disturbance(model.dae, velocities, frictions))
