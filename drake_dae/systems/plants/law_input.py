"""The input port `feedback` of a plant: a law that the plant computes itself."""

from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import proxy, ref

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import CacheEntry, Context, InputPort, LeafSystem, ValueProducer

from drake_dae.arrays import FloatArray
from drake_dae.systems.blocks.feedback import Feedback, motion_under, nothing
from drake_dae.systems.blocks.lifetime import weakly
from drake_dae.systems.blocks.trials import StepWatch
from drake_dae.trace.compiled import Compiled
from drake_dae.trace.functions import TracedFunction


class _FedBack(NamedTuple):
    """The constants of a plant's derivative besides time and state.

    Attributes:
        feedback: The law at `feedback`; None if the control has a wire or a fixed value.
        parameters: Values of all parameters.
        motion: x' under that law as a function of time and state; the next call overwrites its
            array, and it returns None without a value. None without a law.
        entry: The cache entry of this value, kept since looking it up takes longer.
    """

    feedback: Feedback | None
    parameters: FloatArray
    motion: Callable[[float, FloatArray], FloatArray | None] | None
    entry: CacheEntry

    def __deepcopy__(self, memo: dict[int, Any]) -> "_FedBack":
        return self


class LawInput:
    """The input port `feedback` of a plant, and the motion under its law.

    The law is used if the plant's port `control` has neither a wire nor a fixed value.

    Args:
        plant: The plant; gets the port, and keeps this.
        control: Its port `control`.
        values: A function of a context with all parameters; it must not keep the plant alive.
        steps: The plant's steps.
        dynamics: x', a function of state, control and parameters.
        compiled: Whether law and plant together become machine code.

    Attributes:
        port: The port.
    """

    def __init__(
        self,
        plant: LeafSystem,
        control: InputPort,
        values: Callable[[Context], FloatArray],
        steps: StepWatch,
        dynamics: TracedFunction,
        compiled: Compiled,
    ) -> None:
        self._plant, self._control, self._values, self._steps = proxy(plant), control, values, steps
        self._dynamics, self._compiled = dynamics, compiled
        self._motion: tuple[TracedFunction, TracedFunction] | None = None
        self.port = plant.DeclareAbstractInputPort("feedback", nothing())
        sources = {plant.input_port_ticket(port.get_index()) for port in (control, self.port)}
        # Law and parameters are the same for many states: one look at the context instead of three.
        self._index = plant.DeclareCacheEntry(
            "feedback and parameters",
            ValueProducer(nothing, weakly(self._calc)),
            sources | {plant.all_parameters_ticket()},
        ).cache_index()
        # An entry keeps its system alive: a context may hold one, but not the system itself.
        self._entry: Callable[[], CacheEntry | None] = lambda: None

    def _calc(self, context: Context, value: AbstractValue) -> None:
        is_fed_back = not self._control.HasValue(context)
        feedback = self.port.Eval(context) if is_fed_back else None
        motion = None
        parameters = np.array(self._values(context))
        if feedback is not None:
            self._steps.note_law(context, feedback.parameters)
            function = self.motion_under(feedback.function)
            motion = feedback.motion(function, parameters)
        entry = self._plant.get_cache_entry(self._index)
        self._entry = ref(entry)
        value.set_value(_FedBack(feedback, parameters, motion, entry))

    def motion_under(self, law: TracedFunction) -> TracedFunction:
        """Law and plant as one function; see `feedback.motion_under`."""
        if self._motion is None or self._motion[0] is not law:
            self._motion = law, motion_under(law, self._dynamics, self._compiled)
        return self._motion[1]

    def motion(self, context: Context) -> Callable[[float, FloatArray], FloatArray | None] | None:
        """x' as a function of time and state; None without a law."""
        entry = self._entry() or self._plant.get_cache_entry(self._index)
        law: _FedBack = entry.Eval(context)
        return law.motion

    def feedback(self, context: Context) -> Feedback | None:
        """The law at `feedback`; None if the control has a wire or a fixed value."""
        law: _FedBack = self._plant.get_cache_entry(self._index).Eval(context)
        return law.feedback
