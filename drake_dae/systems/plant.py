"""The contract of a plant, and blocks with the parameters of a DaeSystem."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.blocks.block import Block
from drake_dae.blocks.traced_system import TracedSystem, check_context
from drake_dae.dae import ConstraintStructure, DaeSystem, DerivativeLayout, Signal
from drake_dae.errors import ModelError
from drake_dae.robots import RobotModel

if TYPE_CHECKING:
    from pydrake.systems.framework import System
else:
    # Classes of pybind11 have their own metaclass: a plant derives from one of Drake's classes and
    # also from this one.
    System = object

NOWHERE: list[int] = []  # of a block without exogenous parameters


@checked(ModelError)
class Plant(System):
    """The contract of a plant: a Drake System that simulates a `DaeSystem`.

    A plant is a LeafSystem or a Diagram with this class as its last base: `class
    MyPlant(LeafSystem, Plant)`. The defaults here are right for a continuous plant with fixed
    numbers whose continuous state is x.

    1. Ports. The input port `control` is u, shape (p,). The output ports `state`,
       `constraint_force`, `constraint_residual` and `controlled_output` have the entries of
       `dae.state_signals`, `dae.force_signals`, `structure.manifold.residual_signals` and
       `dae.output_signals`.
    2. System. `dae` is the system, and `structure` its structure. `model` is its robot, if it is
       one; then the output port `link_state` is (q, v) of its links.
    3. State. `time_step` is the time between its steps in s, 0 for a continuous plant. `state`
       returns x, shape (n,). A discrete plant uses at each step the control of that instant. A
       record of a plant that projects its state has the state before the projection.
    4. Records. `further_signals` are the output ports in a record besides those of rule 1, with
       names and units of their entries.
    5. Exogenous signals. Exogenous parameters come through an input port `exogenous`, stacked by
       `exogenous_layout`, in place of those at `exogenous_places`. Without a wire they keep their
       values. A plant without such a port has an empty layout and no places.
    6. Parameters. `parameters` are those of a context in the order of `dae.parameters`,
       `current_parameters` the same with the current exogenous ones. `set_parameter` changes one in
       a context; a plant with fixed numbers refuses.
    7. Starts. `set_state` sets x as given. `set_consistent_state` sets the state on N* next to a
       guess, and returns it. Both refuse wrong shapes.
    8. Contact. `is_ideal` says whether the constraints hold exactly. `friction` are the
       coefficients of friction of contacts, those of the plant, which the law may not know; not
       negative.
    """

    __slots__ = ()

    dae: DaeSystem
    structure: ConstraintStructure
    model: RobotModel | None = None
    time_step: float = 0.0
    exogenous_layout: DerivativeLayout = DerivativeLayout(())
    exogenous_places: list[int] = NOWHERE
    is_ideal: bool = True

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        """Name of a further output port in a record -> names and units of its entries."""
        return {}

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        return self.dae.parameter_values

    def current_parameters(self, context: Context) -> FloatArray:
        """All parameters as `parameters`, with exogenous ones at the context's time."""
        return self.parameters(context)

    def friction(self, context: Context) -> dict[str, float]:
        """Name of a constraint -> its coefficient of friction, of those that have one."""
        values, coefficients = self.parameters(context), dict[str, float]()
        for constraint in self.model.constraints if self.model is not None else ():
            if (name := constraint.friction_parameter) is not None:
                coefficients[constraint.name] = float(values[self.dae.parameter_slice(name)].item())
        return coefficients

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context, or refuses to."""
        self.dae.parameter_slice(name)
        raise ModelError(
            f"{self.dae.name}: the numbers of a {type(self).__name__} are fixed when it is made; "
            f"make it with another '{name}'"
        )

    def state(self, context: Context) -> FloatArray:
        """The state x in a context, shape (n,)."""
        check_context(self, context)
        return context.get_continuous_state_vector().CopyToVector()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets the state x in a context as it is given, shape (n,), also off N*."""
        check_context(self, context)
        context.SetContinuousState(self.dae.state_vector(state))

    def set_consistent_state(
        self, context: Context, guess: ArrayLike | Mapping[str, float], fixed: Sequence[str] = ()
    ) -> FloatArray:
        """Sets the state on N* next to a guess, and returns it.

        A guess is x, shape (n,), whose velocities that are not zero are kept where the constraints
        allow it; or name of a state -> its value, which is fixed, others near the nominal state.
        `fixed` are names of further states that keep their values. An InconsistentStateError says
        that there is none.
        """
        parameters = self.current_parameters(context)
        if isinstance(guess, Mapping):
            fixed = [*fixed, *guess]  # Of which the manifold refuses unknown ones.
            pairs = zip(self.dae.state_signals, self.dae.nominal_state, strict=True)
            guess = np.array([guess.get(signal.name, value) for signal, value in pairs])
        state = self.structure.manifold.settle(guess, parameters, fixed)
        self.check_start(state, parameters)
        self.set_state(context, state)
        return state

    def check_start(self, state: FloatArray, parameters: FloatArray) -> None:
        """Refuses a start of a run that is not valid, for these values of all parameters."""

    def robot(self, needed_by: str) -> RobotModel:
        """The robot, or a refusal by what needs one, in words: "an animation"."""
        if self.model is None:
            raise ModelError(
                f"{needed_by} needs a robot, such as a RobotPlant, and '{self.dae.name}' is none"
            )
        return self.model


def port_signals(structure: ConstraintStructure) -> dict[str, tuple[Signal, ...]]:
    """Names and units of the output ports that every plant has."""
    dae = structure.system
    return {
        "state": tuple(dae.state_signals),
        "constraint_force": tuple(dae.force_signals),
        "constraint_residual": tuple(structure.manifold.residual_signals),
        "controlled_output": tuple(dae.output_signals),
    }


def plants_in(diagram: Diagram) -> list[Plant]:
    """The plants in a diagram, at any depth."""
    found = []
    for system in diagram.GetSystems():
        if isinstance(system, Plant):
            found.append(system)
        elif isinstance(system, Diagram):
            found += plants_in(system)
    return found


class ParameterizedSystem(TracedSystem):
    """A block whose numeric parameter 0 begins with all parameters of a DaeSystem.

    Exogenous signals w come through an input port `exogenous` with as many derivatives, `degrees`,
    as the block needs, stacked like references; without a wire they keep the values of the
    parameters, at `exogenous_places`.
    """

    __slots__ = TracedSystem.__slots__

    def __init__(
        self,
        dae: DaeSystem,
        block: Block,
        degrees: Sequence[int] | None = None,
        sees_steps: bool | None = None,
    ) -> None:
        if degrees is None:
            after = (held.next for held in block.held.values())
            values = *block.outputs.values(), block.derivative, *after
            degrees = dae.exogenous.degrees(*values)
        self.dae = dae
        self.exogenous_layout = DerivativeLayout(tuple(degrees))
        self.exogenous_places: list[int] = dae.exogenous.places(degrees) if degrees else []
        if self.exogenous_places:
            block = with_exogenous(block, self.exogenous_places)
        super().__init__(block, compiled=dae.compiled, sees_steps=sees_steps)

    def _values(self, context: Context) -> FloatArray:
        values: FloatArray = context.get_numeric_parameter(0).value()
        if self.exogenous_places and self.GetInputPort("exogenous").HasValue(context):
            values = values.copy()
            values[self.exogenous_places] = self.GetInputPort("exogenous").Eval(context)
        return values

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        self.check_context(context)
        values = context.get_numeric_parameter(0).value()
        return np.array(values[: self.dae.parameter_values.size])

    def current_parameters(self, context: Context) -> FloatArray:
        """All parameters as `parameters`, with exogenous ones at the context's time."""
        self.check_context(context)
        return np.array(self._values(context)[: self.dae.parameter_values.size])

    def get_parameter(self, context: Context, name: str) -> FloatArray:
        """A parameter by name, shape (k,)."""
        return self.parameters(context)[self.dae.parameter_slice(name)]

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context: its value, shape (k,), or a number for all entries."""
        self.check_context(context)
        values = context.get_numeric_parameter(0).CopyToVector()
        put(self.dae, values, name, value)
        context.get_mutable_numeric_parameter(0).SetFromVector(values)


def with_exogenous(block: Block, places: Sequence[int]) -> Block:
    """The block, whose parameters at some places come through an input port `exogenous`."""
    exogenous, parameters = ca.SX.sym("exogenous", len(places)), ca.SX(block.parameters)
    parameters[list(places)] = exogenous
    moved = block.mapped(lambda v: ca.substitute(v, [block.parameters], [parameters]))
    return replace(
        moved,
        inputs={**block.inputs, "exogenous": exogenous},
        defaults={**moved.defaults, "exogenous": block.parameters[list(places)]},
    )


def changed_parameters(model: RobotModel, parameters: Mapping[str, ArrayLike]) -> FloatArray:
    """All parameters of a robot, some of surfaces, masses and loads changed for its plant."""
    values = model.dae.parameter_values
    parts: list[Any] = [model.links, *model.constraints, *model.stages, *model.known_forces]
    known = [parameter.name for part in parts for parameter in part.parameters]
    for name, value in parameters.items():
        if name not in known:
            raise ModelError(
                f"of this plant {unknown_name('parameter', name, known)}; give "
                "the law's model others instead"
            )
        put(model.dae, values, name, value)
    return values


def put(dae: DaeSystem, values: FloatArray, name: str, value: ArrayLike) -> None:
    """Changes a parameter of a system among all their values."""
    place, given = dae.parameter_slice(name), numbers(f"parameter '{name}'", value)
    if given.shape not in ((), (place.stop - place.start,)):
        raise ModelError(
            f"parameter '{name}' has {place.stop - place.start} entries, got {value!r}"
        )
    values[place] = given
    for parameter in dae.parameters:
        if parameter.name == name:
            parameter.check(values[place])
