"""The contract of a controller: the rules for wiring, records and starts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae import (
    ConstraintStructure,
    DaeSystem,
    DerivativeLayout,
    FeedbackGains,
    GainDesign,
    Signal,
    TrackingLaw,
)
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.plants.contract import NOWHERE, Plant

if TYPE_CHECKING:
    from pydrake.systems.framework import System
else:
    System = object  # pybind11 has its own metaclass, as for plants.

Derived = dict[str, tuple[FloatArray, tuple[Signal, ...]]]
"""Name of a signal -> its values, one row for each time, and their names and units."""

Compared = tuple[FloatArray, FloatArray, Sequence[Signal]]
"""Outputs z and their desired values, shape (k,) each, and their names and units."""

SIGNAL = "signal_"  # the beginning of the name of an input port for a signal


@checked(ModelError)
@dataclass(frozen=True)
class PhaseChange:
    """The start of a phase of a task, with time, force, distance and its rate in SI units.

    `phase` is its name, or "done" or "held" where the robot rests, and `place` its index in the
    task. `in_contact` says whether the law for contact is active from then on, `reason` why the
    phase before ended, and `failed` whether it failed; of "held", whether the task was given up.
    """

    time: float
    phase: str
    place: int
    in_contact: bool
    reason: str
    force: float
    distance: float
    distance_rate: float
    failed: bool = False

    def __str__(self) -> str:
        return (
            f"{self.time:.6g} s: {self.phase}, {self.reason}; {self.force:.4g} N, "
            f"{self.distance:.4g} m, {self.distance_rate:.3g} m/s"
        )


@checked(ModelError)
class Controller(System):
    """The contract of a controller: a Drake System that computes the control of a plant.

    A controller is a LeafSystem or a Diagram with this class as its last base. The defaults here
    apply to everything that it does not override.

    1. Inputs. The input port `estimated_state` is x, shape (n,). Further input ports, if needed:
       `reference` (R of its `law`), `measured_force` (all constraint forces), `exogenous` (as of a
       `Plant`), `hold` (no integral of `law` is updated while it is not 0), and signal_<name> for
       each signal for which it waits. One that plans its references itself has the output port
       `contact_reference` for an observer, and `tared_force` where it corrects the measured force.
    2. Outputs. The output port `control` is u, shape (p,). `further_signals` are the other output
       ports in a record, with names and units; `shown` are those that a loop exports without
       recording them.
    3. Laws. `law` is the tracking law that acts in contact, of a system of the plant's sizes, and
       `all_parameters` are the parameters of its function. `set_gains` changes its gains in a
       context; a controller with fixed gains refuses.
    4. Plants. `check_plant` refuses a plant that does not fit.
    5. Computed afterwards. `derived` are further signals of a record, computed from the others.
       `compared` are outputs and their references now, for the check of divergence. With `follows`
       its control is that of `law` alone.
    6. Theory. `predicted_error` is the predicted tracking error of a record.
    7. Starts. With `takes_over` its references start at the current outputs; otherwise they come
       from a generator, and a run starts at their start. A run starts on the manifold of
       `start_structure`.
    8. Phases. `changes` are the starts of the phases of a run, with reasons, from its record, and
       `phase_names` the names of the phases and of the rest after them; both are empty without
       phases.
    """

    __slots__ = ()

    law: TrackingLaw
    shown: tuple[str, ...] = ()
    phase_names: tuple[str, ...] = ()
    follows: bool = False
    takes_over: bool = False
    exogenous_layout: DerivativeLayout = DerivativeLayout(())
    exogenous_places: list[int] = NOWHERE

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        """Name of a further output port in a record -> names and units of its entries."""
        return {}

    @property
    def start_structure(self) -> ConstraintStructure:
        """The structure on whose manifold a run starts."""
        return self.law.structure

    def all_parameters(self, context: Context) -> FloatArray:
        """The parameters of the law's function: the model's at the context's time, and K."""
        return self.law.all_parameters()

    def current_parameters(self, context: Context) -> FloatArray:
        """The parameters of the law's model at the context's time, shape (k,)."""
        return self.law.system.parameter_values

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        """Changes the gains of the law in a context, or refuses to."""
        raise ModelError(f"the gains of a {type(self).__name__} are fixed when it is made")

    def check_plant(self, plant: Plant) -> None:
        """Refuses a plant that does not fit, by a WiringError."""
        check_law(plant.dae, self.law)

    def derived(self, values: Mapping[str, FloatArray]) -> Derived:
        """Desired outputs, errors and others from the other signals of a record."""
        return {}

    def compared(self, context: Context, shown: Callable[[str], FloatArray]) -> Compared | None:
        """The outputs now and their desired values; `shown` has the value of a plant's signal."""
        port = self.GetInputPort("reference") if self.HasInputPort("reference") else None
        if port is None or not port.HasValue(context):
            return None
        desired = port.Eval(context)[self.law.layout.lowest]
        return shown("controlled_output"), desired, self.law.system.output_signals

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """The predicted tracking error, one row for each time of a record with these values."""
        raise NotImplementedError

    def changes(self, values: Mapping[str, FloatArray]) -> tuple[PhaseChange, ...]:
        """The start of each phase of a run, with the reason, from the signals of its record."""
        return ()


def check_law(dae: DaeSystem, law: TrackingLaw) -> None:
    """Refuses a law for a system of another size than the plant's, by a WiringError."""
    remedy = "the law for the plant's system, TrackingLaw(plant.dae, ...), or for one like it"
    check_same_sizes(dae, law.system, "law", remedy)


def check_same_sizes(dae: DaeSystem, other: DaeSystem, what: str, remedy: str) -> None:
    """Refuses a part for `other`, a system of another size than the plant's."""
    sizes = [(s.num_states, s.num_controls, s.num_constraints) for s in (dae, other)]
    if sizes[0] != sizes[1]:
        has, takes = ("{} states, {} controls and {} constraints".format(*size) for size in sizes)
        raise WiringError(
            f"the {what} is for '{other.name}' with {takes}, the plant '{dae.name}' has {has}. "
            f"Make {remedy}"
        )
