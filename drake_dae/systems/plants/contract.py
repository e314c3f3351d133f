"""What every plant keeps: the rules that wiring, records, pictures and starts go by."""

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiagramBuilder

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.layout import Layout
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.plants.contact_events import ContactEvent
from drake_dae.trace.functions import TracedFunction

if TYPE_CHECKING:
    from pydrake.systems.framework import System
else:
    # Classes of pybind11 have a metaclass of their own: a plant derives from one of Drake's, and
    # from this class besides.
    System = object

NOWHERE: list[int] = []
"""Where the parameters stand that move, in a block in which none does."""


@checked(ModelError)
class Plant(System):
    """The contract of a plant: a Drake System that simulates a `DaeSystem`.

    A plant is a LeafSystem or a Diagram that takes this class as its last base:
    `class MyPlant(LeafSystem, Plant)`. What it does not say itself is as it stands here, which
    is right for a continuous plant with fixed numbers whose continuous state is x.

    1. Ports. The input port `control` is u, shape (p,). The output ports `state`,
       `constraint_force`, `constraint_residual` and `controlled_output` have the entries of
       `dae.state_signals`, `dae.force_signals`, `structure.manifold.residual_signals` and
       `dae.output_signals`.
    2. System. `dae` is the system, and `structure` its structure with all contacts closed.
    3. Robots. `model` is the robot whose system `dae` is; then the output port `link_state` is
       (q, v) of its links. It is None for a plant that is no robot.
    4. State and steps. `time_step` is the time between its steps in s, and 0 where it is
       continuous. `state` returns x, shape (n,). A discrete plant takes at each step the control
       that it finds then.
    5. Records. `further_signals` names the output ports that a record has beside those of
       rule 1, with names and units of their entries.
    6. What is computed afterwards. `functions` names the output ports that `along` computes from
       what was logged: "state", "control", "parameters" and the ports of rule 5 that are not among
       `functions`. Of a plant without functions everything is logged at its steps.
    7. Exogenous signals. Parameters that move come through an input port `exogenous`, stacked as
       `exogenous_layout` says, in place of those at `exogenous_places`. Without a wire they keep
       their values. A plant without such a port has an empty layout and no places.
    8. Parameters. `parameters` are those of a context in the order of `dae.parameters`,
       `current_parameters` the same with what moves as it is now, and `parameters_along` those
       that it had at the times of a run. `set_parameter` changes one in a context; a plant whose
       numbers are fixed when it is made refuses.
    9. Starts. `set_state` sets x as given. `set_consistent_state` sets the state on N* next to a
       guess, with all contacts closed, and returns it. Both refuse another shape.
    10. Opening contacts. `contacts` names the contacts that open and close, in the order of the
        output port `mode`, whose entries are 1 for closed and 0 for open; `normals` is where their
        forces stand in `constraint_force`. While one is open its force is zero, and the integral of
        its error in a law stands still. `events` tells what happened to them in a run. A plant
        without such contacts has no names, no places and no events.
    11. Projection. `projects` says whether the state is put back onto N* after each step; then a
        record has it as it was before.
    12. Feedback. A plant that can compute its control itself has an input port `feedback`, which
        takes a law as a value; see `DaePlant`. `laws_along` are the parameters of the law that
        was fed back at the times of a run, and None where none was.
    13. Contact. `is_ideal` says whether the constraints hold exactly while contacts are closed.
    14. Live view. `add_own_view` adds what Meshcat shows of this plant beside links, surfaces and
        constraint forces.
    """

    __slots__ = ()

    dae: DaeSystem
    structure: ConstraintStructure
    model: RobotModel | None = None
    time_step: float = 0.0
    functions: Collection[str] = ()
    exogenous_layout: Layout = Layout(())
    exogenous_places: list[int] = NOWHERE
    contacts: tuple[str, ...] = ()
    normals: tuple[int, ...] = ()
    projects: bool = False
    is_ideal: bool = True

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        """Name of an output port that a record has besides -> names and units of its entries."""
        return {}

    def along(self, port: str, given: Mapping[str, FloatArray]) -> FloatArray:
        """What a port of `functions` showed at moments, one row for each; nan where nothing.

        Args:
            port: The port's name.
            given: "state", "parameters", "control" and the logged ports at each moment, one row for
                each.

        Raises:
            ModelError: There is no such port.
        """
        raise ModelError(f"{self.dae.name}: nothing tells what its port '{port}' showed")

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        return self.dae.parameter_values

    def current_parameters(self, context: Context) -> FloatArray:
        """All parameters as `parameters`, those that move as they are at the context's time."""
        return self.parameters(context)

    def parameters_along(self, context: Context, times: ArrayLike) -> FloatArray:
        """The parameters that the plant had at the times of a run, in s, one row for each."""
        return np.tile(self.parameters(context), (np.size(times), 1))

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context.

        Raises:
            ModelError: No parameter has that name, the value does not fit, or the numbers of this
                plant are fixed when it is made.
        """
        self.dae.parameter_slice(name)
        raise ModelError(
            f"{self.dae.name}: the numbers of a {type(self).__name__} are fixed when it is made; "
            f"make it with another '{name}'"
        )

    def state(self, context: Context) -> FloatArray:
        """The state x in a context, shape (n,)."""
        return context.get_continuous_state_vector().CopyToVector()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets the state x in a context as it is given, shape (n,).

        A run is refused from a state that is not on N*.

        Raises:
            ModelError: The shape is wrong.
        """
        context.SetContinuousState(self.dae.state_vector(state))

    def set_consistent_state(self, context: Context, guess: ArrayLike) -> FloatArray:
        """Sets the state on N* next to a guess, shape (n,), and returns it.

        Raises:
            InconsistentStateError: None is found near the guess.
        """
        state = self.structure.manifold.settle(guess, self.current_parameters(context))
        self.set_state(context, state)
        return state

    def events(self, context: Context) -> tuple[ContactEvent, ...]:
        """What happened to contacts since the run of a context began."""
        return ()

    def laws_along(self, context: Context, times: ArrayLike) -> FloatArray | None:
        """The parameters of the law that was fed back, one row for each time; None if none was."""
        return None

    def motion_under(self, law: TracedFunction) -> TracedFunction:
        """Law and plant as one function, of a plant that takes a law as a value."""
        raise ModelError(f"{self.dae.name}: no law can be fed back to a {type(self).__name__}")

    def add_own_view(self, builder: DiagramBuilder, meshcat: Meshcat) -> None:
        """Adds what Meshcat shows of this plant alone, with its wires.

        Args:
            builder: The builder of the diagram, with the plant in it.
            meshcat: Where to draw.
        """

    def robot(self, needed_by: str) -> RobotModel:
        """The robot.

        Args:
            needed_by: What needs one, in words: "an animation".

        Raises:
            ModelError: There is none.
        """
        if self.model is None:
            raise ModelError(
                f"{needed_by} needs a robot, as of a RobotPlant, and '{self.dae.name}' is none"
            )
        return self.model
