"""Drives with limited control."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.blocks.block import Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.errors import ModelError


@checked(ModelError)
class ControlLimits(TracedSystem):
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
        self.limits = np.array(limits, dtype=float)
        if self.limits.ndim != 1 or not self.limits.size or not np.all(self.limits > 0.0):
            raise ModelError(f"limits must be positive numbers of shape (p,), got {limits!r}")
        control = ca.SX.sym("control", self.limits.size)
        limited = ca.fmax(-self.limits, ca.fmin(self.limits, control))
        outputs = {
            "control": limited,
            "excess": control - limited,
            "is_limited": ca.mmax(ca.fabs(control) - self.limits) > 0,
        }
        super().__init__(Block("control_limits", {"control": control}, outputs))
