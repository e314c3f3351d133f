"""The signals of a record that are computed from the logged signals."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from pydrake.systems.framework import Context, OutputPort, System

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import DrakeDaeError, WiringError
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.parameterized import function_along
from drake_dae.systems.plants.contract import Plant


class RecordedLoop(Protocol):
    """The parts of a closed loop that `completed` needs; see `ClosedLoop`."""

    @property
    def plant(self) -> Plant:
        """The plant."""

    @property
    def controller(self) -> Controller:
        """The controller."""

    @property
    def generator(self) -> ReferenceGenerator | None:
        """The generator of references, or None."""

    @property
    def signals(self) -> Mapping[str, Sequence[Signal]]:
        """Names and units of each signal that is logged or computed here."""

    @property
    def exogenous(self) -> ReferenceGenerator | None:
        """The source of the law's exogenous signals, or None."""

    @property
    def plant_exogenous(self) -> ReferenceGenerator | None:
        """The source of the plant's exogenous signals, or None."""

    @property
    def state_source(self) -> OutputPort:
        """The port of the state that the controller gets."""


def completed(logged: Record, loop: RecordedLoop, context: Context) -> Record:
    """Adds the signals that are computed from the log of a loop.

    Args:
        logged: The logged signals.
        loop: The loop, whose plant has `functions`.
        context: The context of its diagram after the run.

    Raises:
        WiringError: An input port of plant or controller has a fixed value in this context, since
            an unknown time.
    """
    _refuse_fixed_ports(loop, context)
    plant = loop.plant
    times, values = logged.time, {name: logged[name] for name in logged.signals}
    inputs = {**values, "parameters": _parameters_along(loop, plant, context, times)}
    if "exogenous" in values:  # Logged, since it does not follow from the time.
        inputs["parameters"][:, plant.exogenous_places] = values["exogenous"]
    elif loop.plant_exogenous is not None:
        values["exogenous"] = _along(loop.plant_exogenous, times, context)
    if loop.generator is not None and "reference" not in values:
        values["reference"] = _along(loop.generator, times, context)
    if "control" not in inputs:
        law_inputs = {**inputs, "reference": values["reference"]}
        values["control"] = inputs["control"] = _control_along(loop, context, times, law_inputs)
    values |= {port: plant.along(port, inputs) for port in plant.functions}
    return Record(times, {n: Recorded(values[n], tuple(loop.signals[n])) for n in loop.signals})


def _control_along(
    loop: RecordedLoop, context: Context, times: FloatArray, inputs: dict[str, FloatArray]
) -> FloatArray:
    """The control of a continuous law, as a function of the other signals."""
    plant, law = loop.plant, loop.controller.law
    gains = _parameters_along(loop, loop.controller, context, times)
    if law.measured_force and "measured_force" not in inputs:
        # Without a sensor; a law that only integrates the force does not need it here.
        inputs["measured_force"] = (
            plant.along("constraint_force", inputs)
            if law.control_takes_force
            else np.zeros((times.size, plant.dae.num_constraints))
        )
    return function_along(law.function, {**inputs, "parameters": gains})


def _parameters_along(
    loop: RecordedLoop, block: Plant | Controller, context: Context, times: FloatArray
) -> FloatArray:
    """The parameters of a block at each time, with exogenous ones."""
    values = block.parameters_along(block.GetMyContextFromRoot(context), times)
    moving = loop.plant_exogenous if block is loop.plant else loop.exogenous
    if moving is not None:
        values[:, block.exogenous_places] = _along(moving, times, context)
    return values


def _along(generator: ReferenceGenerator, times: FloatArray, context: Context) -> FloatArray:
    return generator.along(times, generator.GetMyContextFromRoot(context))


def _refuse_fixed_ports(loop: RecordedLoop, context: Context) -> None:
    controller = loop.controller
    at_controller = controller.GetMyContextFromRoot(context)
    sources = {"estimated_state": loop.state_source}
    if loop.generator is not None:
        sources["reference"] = loop.generator.GetOutputPort("reference")
    for name, source in sources.items():
        port = controller.GetInputPort(name)
        try:
            value = source.Eval(source.get_system().GetMyContextFromRoot(context))
        except DrakeDaeError:
            continue  # At the failure of a run.
        if not np.array_equal(value, port.Eval(at_controller), equal_nan=True):
            raise _fixed(name, controller)


def _fixed(port: str, block: System) -> WiringError:
    return WiringError(
        f"the port '{port}' of {block.get_name()} has a fixed value in this context, so that its "
        "control does not follow from the state; wire plant and controller in a diagram of your "
        "own, with a LogVectorOutput"
    )
