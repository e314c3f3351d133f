"""What every controller of a loop keeps: the rules that wiring, records and starts use."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.layout import Layout
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import FeedbackGains, GainDesign
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.plants.contract import NOWHERE, Plant

if TYPE_CHECKING:
    from pydrake.systems.framework import System
else:
    System = object  # As for plants: pybind11 has a metaclass of its own.

Derived = dict[str, tuple[FloatArray, tuple[Signal, ...]]]
"""Name of a signal -> its values, one row for each time, and their names and units."""

Compared = tuple[FloatArray, FloatArray, Sequence[Signal]]
"""Outputs z, what they should be, both of shape (k,), and their names and units."""


@checked(ModelError)
class Controller(System):
    """The contract of a controller: a Drake System that computes the control of a plant.

    A controller is a LeafSystem or a Diagram that takes this class as its last base. What it does
    not say itself is as it stands here.

    1. What it reads. The input port `estimated_state` is x, shape (n,). It has further input ports
       as far as it needs them: `reference` (R of its `law`), `measured_force` (all constraint
       forces), `exogenous` (as of a `Plant`), and `hold` (one entry for each integral of `law`,
       which stands still where it is not 0).
    2. What it gives. The output port `control` is u, shape (p,). `further_signals` names the output
       ports that a record has besides, with names and units; `shown` names those that a loop
       exports and no record has.
    3. Laws. `law` is the tracking law that acts in contact, of a system of the plant's sizes, and
       `all_parameters` what its function takes as parameters. `set_gains` changes its gains in a
       context; a controller whose gains are fixed when it is made refuses.
    4. Plants and parts. `check_plant` refuses a plant that the controller is not for. `refused`
       names the settings of a loop that it cannot be wired with, each with a sentence.
    5. What is computed afterwards. With `follows` its control is a function of the logged state,
       the reference, the forces, the integrals and its parameters: `law.function`. Otherwise it is
       logged. `derived` is what else a record has of it, from the other signals.
       `compared` is what a run is watched by: outputs now, and what they should be.
    6. Theory. `predicted_error` is what the tracking error of a record should be.
    7. Starts. With `takes_over` its references begin with the outputs that the robot has then;
       otherwise they come from a generator, and a run begins where that begins. A run begins on the
       manifold of `start_structure`.
    8. Phases. `changes` tells when the phases of a run began, and why; none where there are none.
    """

    __slots__ = ()

    law: TrackingLaw
    shown: tuple[str, ...] = ()
    refused: Mapping[str, str] = {}
    follows: bool = False
    takes_over: bool = False
    exogenous_layout: Layout = Layout(())
    exogenous_places: list[int] = NOWHERE

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        """Name of an output port that a record has besides -> names and units of its entries."""
        return {}

    @property
    def start_structure(self) -> ConstraintStructure:
        """The structure whose manifold a run begins on."""
        return self.law.structure

    def all_parameters(self, context: Context) -> FloatArray:
        """What the law's function takes as parameters: the model's at the context's time, and K."""
        return self.law.all_parameters()

    def current_parameters(self, context: Context) -> FloatArray:
        """The parameters of the law's model at the context's time, shape (k,)."""
        return self.law.system.parameter_values

    def parameters_along(self, context: Context, times: ArrayLike) -> FloatArray:
        """What the law's function took as parameters at the times of a run, one row for each."""
        return np.tile(self.all_parameters(context), (np.size(times), 1))

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        """Changes the gains of the law in a context.

        Raises:
            GainError: The gains do not fit.
            ModelError: The gains of this controller are fixed when it is made.
        """
        raise ModelError(f"the gains of a {type(self).__name__} are fixed when it is made")

    def check_plant(self, plant: Plant) -> None:
        """Refuses a plant that the controller is not for.

        Raises:
            WiringError: Why, and what would fit.
        """
        check_law(plant.dae, self.law)

    def derived(
        self,
        context: Context | None,
        times: FloatArray,
        values: Mapping[str, FloatArray],
    ) -> Derived:
        """What follows of a record: its desired outputs, errors and others.

        Args:
            context: The context of this system after the run; None where there was none.
            times: The times of the record, in s, shape (k,).
            values: The other signals of the record and the plant's "parameters", one row for each
                time.
        """
        return {}

    def compared(self, context: Context, shown: Callable[[str], FloatArray]) -> Compared | None:
        """The outputs now and what they should be, with their names; None where nobody tells it.

        Args:
            context: The context of this system.
            shown: Name of a signal of the plant, such as "controlled_output" -> its value.
        """
        if (reference := self.reference_now(context)) is None:
            return None
        law = self.law
        return shown("controlled_output"), reference[law.layout.lowest], law.system.output_signals

    def reference_now(self, context: Context) -> FloatArray | None:
        """R: what is wired or fixed, or what the references are by themselves; None without any."""
        port = self.GetInputPort("reference") if self.HasInputPort("reference") else None
        return port.Eval(context) if port is not None and port.HasValue(context) else None

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """The tracking error that theory predicts, one row for each time.

        Args:
            times: The times of the record, in s, shape (k,).
            values: The signals of the record.
            parameters: Those of the law's model at its start.
        """
        raise NotImplementedError

    def changes(self, context: Context) -> tuple[PhaseChange, ...]:
        """When each phase of a run began, and why."""
        return ()


def check_law(own: DaeSystem, law: TrackingLaw) -> None:
    """Refuses a law for a system of another size than the plant's.

    Args:
        own: The plant's system.
        law: The law.

    Raises:
        WiringError: It is.
    """
    remedy = "the law for the plant's system, TrackingLaw(plant.dae, ...), or for"
    check_same_sizes(own, law.system, "law", f"{remedy} a model of the same structure")


def check_same_sizes(own: DaeSystem, other: DaeSystem, what: str, remedy: str) -> None:
    """Refuses what is for a system of another size than the plant's.

    Args:
        own: The plant's system.
        other: What it is for.
        what: What is wired to the plant.
        remedy: What to make instead.

    Raises:
        WiringError: It is.
    """
    sizes = [(s.num_states, s.num_controls, s.num_constraints) for s in (own, other)]
    if sizes[0] != sizes[1]:
        has, takes = ("{} states, {} controls and {} constraints".format(*size) for size in sizes)
        raise WiringError(
            f"the {what} is for '{other.name}' with {takes}, the plant '{own.name}' has {has}. "
            f"Make {remedy}"
        )
