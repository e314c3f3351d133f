"""Drives with limited control."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, LeafSystem

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import Block, Computation
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value
from drake_dae.errors import ModelError


@checked(ModelError)
class ControlLimits(LeafSystem):
    """Limits each control, and reports the excess.

    Input port:
        control: The control before the limits, shape (p,).

    Output ports:
        control: The limited control, max(-limit, min(limit, control)), shape (p,).
        excess: The control minus the limited control, shape (p,): 0 within the limits.
        is_limited: 1 while any control is limited, else 0, shape (1,); for the `hold` of a
            `TrackingController` with integrals.

    Args:
        limits: The largest |control|, shape (p,), positive; infinite without a limit.

    Raises:
        ModelError: A limit is not positive, or there are no limits.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, limits: ArrayLike) -> None:
        super().__init__()
        self.set_name("control_limits")
        self.limits = np.array(limits, dtype=float)
        if self.limits.ndim != 1 or not self.limits.size or not np.all(self.limits > 0.0):
            raise ModelError(f"limits must be positive numbers of shape (p,), got {limits!r}")
        size = self.limits.size
        self._port = self.DeclareVectorInputPort("control", size)
        source = {self.input_port_ticket(self._port.get_index())}
        self.DeclareVectorOutputPort("control", size, port_value(self._limited), source)
        self.DeclareVectorOutputPort("excess", size, port_value(self._excess), source)
        self.DeclareVectorOutputPort("is_limited", 1, port_value(self._is_limited), source)

    def _limited(self, context: Context) -> FloatArray:
        return np.clip(self._port.Eval(context), -self.limits, self.limits)

    def _excess(self, context: Context) -> FloatArray:
        return np.asarray(self._port.Eval(context) - self._limited(context))

    def _is_limited(self, context: Context) -> list[float]:
        return [float(np.any(np.abs(self._port.Eval(context)) > self.limits))]

    def traced(self) -> Block:
        control = ca.SX.sym("control", self.limits.size)
        limited = ca.fmax(-self.limits, ca.fmin(self.limits, control))
        is_limited = ca.mmax(ca.fabs(control) - self.limits) > 0
        function = ca.Function("limits", [control], [limited, control - limited, is_limited])
        return Block(
            self, (Computation(function, ("control",), ("control", "excess", "is_limited")),)
        )
