"""References as a LeafSystem.                                                         (28)"""

from collections.abc import Callable, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, DependencyTicket

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, all_finite, numbers, unknown_name, vector
from drake_dae.blocks.computations import PARAMETERS, TIME, Block, Computation
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.references import Reference, ReferenceRows, stack_references
from drake_dae.references.reference import not_finite, with_degrees
from drake_dae.systems.blocks.along import signal_along
from drake_dae.systems.blocks.block import DifferentiableSystem
from drake_dae.systems.blocks.formulas import Formula, TracedFormula
from drake_dae.trace.functions import TracedFunction


@checked(ReferenceSignalError)
class ReferenceGenerator(DifferentiableSystem):
    """References of all outputs, stacked, with their derivatives.

    Output port:
        reference: R(t) of (28): r_1, r_1', ..., r_1^(mu_1), r_2, ..., output-major, shape
            (sum (mu_i + 1),).

    Args:
        references: The references, in the order of the outputs; together they cover all of them.
        degrees: The degrees mu_1, ..., mu_p, `TrackingLaw.degrees`.

    Attributes:
        references, degrees: The arguments.
        reference_parameters: Name -> default of each parameter of its references, shape (k,),
            stacked in numeric parameter 0. References may share a parameter by its name.
        function: R(t) with these defaults as a function of the time in s; the next call overwrites
            its array.

    The block converts to AutoDiffXd. If the time has a gradient, each reference needs one more
    derivative.

    Raises:
        ReferenceSignalError: The references cover too few or too many outputs, or are not smooth
            enough; or two of them have different values of a parameter with the same name.
        NonFiniteError: A reference is not finite during a run; the exception has the time.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, references: Sequence[Reference], degrees: Sequence[int]) -> None:
        super().__init__()
        self.set_name("reference")
        covered = sum(reference.size for reference in references)
        if covered != len(degrees):
            raise ReferenceSignalError(
                f"the references cover {covered} outputs, the law has {len(degrees)}"
            )
        self.references, self.degrees = tuple(references), tuple(degrees)
        self.function = stack_references(references, degrees)
        self.reference_parameters = _common_parameters(self.references)
        if self.reference_parameters:
            values = np.concatenate([*self.reference_parameters.values()])
            self.DeclareNumericParameter(BasicVector(values))
        self._declare_reference({self.time_ticket(), self.all_parameters_ticket()})

    def _declare_reference(self, sources: set[DependencyTicket]) -> None:
        """Declares the port of R.

        Args:
            sources: The dependencies of R.
        """
        size = sum(degree + 1 for degree in self.degrees)
        calculate = weakly(self._calc_reference)
        self.DeclareVectorOutputPort("reference", size, calculate, sources)

    @property
    def further_signals(self) -> dict[str, tuple[Signal, ...]]:
        """Name of an output port beside `reference` -> names and units, for a record."""
        return {}

    @property
    def follows_time(self) -> bool:
        """Whether R follows from the time and the parameters in a context."""
        return not (self.num_input_ports() or self.num_continuous_states())

    def reference(self, time: float) -> FloatArray:
        """R(t) at a time in s by the defaults of its parameters, shape (sum (mu_i + 1),)."""
        return self.function(time).copy()

    def along(self, times: ArrayLike, context: Context | None = None) -> FloatArray:
        """R(t) at many times in s, one row for each; nan without a value.

        Args:
            times: The times.
            context: The block's context with the values of parameters; the defaults if None.
        """
        moments = vector("times", times, None, ReferenceSignalError)
        function = self.function if context is None else self._in(context)
        return signal_along(function, self.get_output_port().size(), moments)

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter of its references in a context.

        Args:
            context: The context of this system.
            name: Its name.
            value: The new value, shape (k,), or a number for all entries.

        Raises:
            ReferenceSignalError: There is no such parameter, or the value does not fit.
        """
        self.check_context(context)
        if name not in self.reference_parameters:
            error = unknown_name("parameter of references", name, self.reference_parameters)
            raise ReferenceSignalError(error)
        size = self.reference_parameters[name].size
        given = numbers(f"parameter '{name}'", value, ReferenceSignalError)
        if given.shape not in ((), (size,)) or not all_finite(given):
            raise ReferenceSignalError(
                f"parameter '{name}' takes {size} finite numbers, got {value!r}"
            )
        values = context.get_numeric_parameter(0).CopyToVector()
        values[self.places(name)] = given
        context.get_mutable_numeric_parameter(0).SetFromVector(values)

    def places(self, name: str) -> slice:
        """Returns the entries of numeric parameter 0 that belong to a named parameter."""
        first = 0
        for known, value in self.reference_parameters.items():
            if known == name:
                return slice(first, first + value.size)
            first += value.size
        raise ReferenceSignalError(
            unknown_name("parameter of references", name, self.reference_parameters)
        )

    def _in(self, context: Context) -> Callable[[float], FloatArray]:
        """R(t) by the parameters of a context."""
        if not self.reference_parameters:
            return self.function
        values = context.get_numeric_parameter(0).value()

        def evaluate(time: float) -> FloatArray:
            (reference,) = self._traced.evaluate(np.array([time]), values)
            if not self._traced.is_valid:
                raise not_finite(time, reference)
            return reference

        return evaluate

    def _calc_reference(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._in(context)(context.get_time()))

    @cached_property
    def _traced(self) -> TracedFunction:
        """R as a function of the time and, if there are any, the parameters."""
        inputs = {"time": ca.SX.sym("t")}
        symbols = {
            name: ca.SX.sym(name, value.size) for name, value in self.reference_parameters.items()
        }
        references = [reference.with_parameters(symbols) for reference in self.references]
        rows = traced_references(references, self.degrees, inputs["time"])
        if symbols:
            inputs["parameters"] = ca.vertcat(*symbols.values())
        return TracedFunction("reference", inputs, {"R": rows})

    def traced(self) -> Block:
        sources = (TIME, PARAMETERS) if self.reference_parameters else (TIME,)
        return Block(self, (Computation.of(self._traced, sources, ("reference",)),))

    def _formulas(self) -> dict[str, Formula]:
        if self.reference_parameters:
            return {"reference": TracedFormula(self._traced, "R")}
        return {"reference": _ReferenceFormula(self.references, self.degrees)}


def _common_parameters(references: Sequence[Reference]) -> dict[str, FloatArray]:
    """The parameters of all references.

    Raises:
        ReferenceSignalError: Two have different values for one name.
    """
    common: dict[str, FloatArray] = {}
    for reference in references:
        for name, value in reference.parameters.items():
            if not np.array_equal(common.setdefault(name, value), value):
                raise ReferenceSignalError(
                    f"two references have a parameter '{name}', with {common[name]} and {value}: "
                    "give them one value, or two names"
                )
    return common


def traced_references(
    references: Sequence[Reference], degrees: Sequence[int], time: ca.SX
) -> ca.SX:
    """R(t) of references at a symbolic time, shape (sum (mu_i + 1), 1).

    Raises:
        ModelError: One is no expression of time.
    """
    rows = [ca.SX(0, 1)]
    for reference, its_degrees in with_degrees(references, degrees):
        row = reference.expression(its_degrees, time)
        if row is None:
            whole = reference.reference if isinstance(reference, ReferenceRows) else reference
            raise ModelError(
                f"a {type(whole).__name__} is no expression of time, and rollouts, exports and "
                "pages need one: take an ExpressionReference, PointToPointReference or "
                "SinusoidReference, or run the loop by simulate"
            )
        rows.append(row)
    return ca.vertcat(*rows)


class _ReferenceFormula:
    """R(t); its derivative by the time needs one more derivative of each reference."""

    sources = ("time",)

    def __init__(self, references: Sequence[Reference], degrees: Sequence[int]) -> None:
        self._evaluate = stack_references(references, degrees)
        self._references, self._degrees = references, degrees

    def value(self, time: float, *arguments: FloatArray) -> FloatArray:
        return self._evaluate(time).copy()

    @cached_property
    def _higher(self) -> Callable[[float], FloatArray]:
        return stack_references(self._references, [degree + 1 for degree in self._degrees])

    def slope(self, moving: tuple[int, ...], time: float, *arguments: FloatArray) -> FloatArray:
        higher = DerivativeLayout(tuple(degree + 1 for degree in self._degrees))
        return np.delete(self._higher(time), higher.lowest)[:, None]
