"""The recorded signals of a closed loop, and their log."""

from collections.abc import Sequence

from pydrake.systems.framework import DiagramBuilder, OutputPort, TriggerType
from pydrake.systems.primitives import LogVectorOutput, Multiplexer, VectorLogSink

from drake_dae.dae import Signal, TrackingLaw
from drake_dae.diagrams.state_feedback import MeasuredState
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.observing.estimator import StateEstimator
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.sensing.force_sensor import ForceSensor

Named = dict[str, tuple[OutputPort, Sequence[Signal]]]
"""Name -> output port, names and units of a recorded signal."""


def log_signals(
    builder: DiagramBuilder,
    plant: Plant,
    controller: Controller,
    named: Named,
) -> VectorLogSink:
    """Exports all signals, and logs them as one vector."""
    for name, (port, _) in named.items():
        builder.ExportOutput(port, name)
    for name in controller.shown:
        builder.ExportOutput(controller.GetOutputPort(name), name)
    if plant.model is not None:
        builder.ExportOutput(plant.GetOutputPort("link_state"), "link_state")
    return log_steps(builder, [port for port, _ in named.values()], plant)


def signals_of_plant(
    plant: Plant,
    moving: ReferenceGenerator | None,
    reference: ReferenceGenerator | None,
    law: TrackingLaw | None,
    control: OutputPort,
) -> Named:
    """The signals of every plant and its inputs that a record contains."""
    dae, named = plant.dae, Named()
    if moving is not None:
        signals = plant.exogenous_layout.reference_signals(dae.exogenous.signals)
        named["exogenous"] = (moving.get_output_port(), signals)
    for name, signals in plant.port_signals.items():
        named[name] = (plant.GetOutputPort(name), signals)
    if reference is not None and law is not None:
        named["reference"] = (reference.GetOutputPort("reference"), law.reference_signals)
    return {**named, "control": (control, dae.control_signals)}


def signals_of_parts(
    plant: Plant,
    controller: Controller,
    measured: MeasuredState | None,
    limits: ControlLimits | None,
    observer: StateEstimator | None,
    sensor: ForceSensor | None,
) -> Named:
    """The further signals of controller, parts and plant that a record contains."""
    dae, named = plant.dae, Named()
    estimates = observer is not None and observer.HasOutputPort("estimated_state")
    if measured is not None:
        name = "measured_state" if estimates else "estimated_state"
        named[name] = (measured.output, dae.state_signals)
    if observer is not None and estimates:
        named["estimated_state"] = (observer.GetOutputPort("estimated_state"), dae.state_signals)
    if limits is not None:
        named["excess"] = (limits.GetOutputPort("excess"), dae.control_signals)
    for block in (controller, observer):
        if block is not None:
            named |= further_signals(block)
    if sensor is not None:
        port = sensor.GetOutputPort("measured_force")
        named["measured_force"] = (port, dae.constraint_input_signals)
    return named | further_signals(plant)


def further_signals(block: Plant | Controller | StateEstimator | ReferenceGenerator) -> Named:
    """The further signals of a block."""
    return {name: (block.GetOutputPort(name), s) for name, s in block.further_signals.items()}


def log_steps(builder: DiagramBuilder, ports: Sequence[OutputPort], plant: Plant) -> VectorLogSink:
    """Adds one log of several ports, stacked, with one sample per step.

    For a discrete plant the log is periodic, since after the last step of a run the state of the
    plant belongs to a time that the run has not reached.
    """
    stacked = builder.AddSystem(Multiplexer([port.size() for port in ports]))
    stacked.set_name("logged_signals")
    for index, port in enumerate(ports):
        builder.Connect(port, stacked.get_input_port(index))
    port = stacked.get_output_port()
    if plant.time_step:
        triggers = {TriggerType.kPeriodic}
        log = builder.AddSystem(VectorLogSink(port.size(), triggers, plant.time_step))
        builder.Connect(port, log.get_input_port())
        return log
    return LogVectorOutput(port, builder, {TriggerType.kPerStep})
