"""Disturbance forces on a robot."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import Context, LeafSystem

from drake_dae.arguments import checked
from drake_dae.arrays import brief, number, positive
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.errors import ModelError
from drake_dae.references import ExpressionReference
from drake_dae.robots import Vector


@checked(ModelError)
@dataclass(frozen=True)
class DisturbanceForce:
    """A disturbance force F on a point of a frame, with a smooth rise and fall:

        F(t) = F (s((t - start_time) / rise) - s((t - end_time) / rise)),    s(x) = 3 x^2 - 2 x^3

    between x = 0 and 1, before it 0 and after it 1.

    Attributes:
        frame: Name of the frame.
        force: F in the world, N, shape (3,).
        start_time: The start, s.
        end_time: The start of the fall, s; None for never.
        rise: The duration of the rise and of the fall, s.
        point: The point in the frame, m, shape (3,).

    Raises:
        ModelError: It ends before it begins, or a number is not valid.
    """

    frame: str
    force: Vector
    start_time: float = 0.0
    end_time: float | None = None
    rise: float = 0.01
    point: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.frame == "world":
            raise ModelError("a disturbance on the world moves nothing; name a frame of the robot")
        positive("the rise of a disturbance", self.rise)
        start = number("the start_time of a disturbance", self.start_time)
        if self.end_time is not None and not self.end_time > start:
            raise ModelError(
                f"a disturbance must end after it begins, at {start:g} s; its end_time is "
                f"{brief(self.end_time)}"
            )

    @property
    def reference(self) -> ExpressionReference:
        """F(t) as three rows."""
        return ExpressionReference(
            lambda time: [component * self._share(time) for component in self.force]
        )

    @property
    def course(self) -> ExpressionReference:
        """The factor of F."""
        return ExpressionReference(lambda time: [self._share(time)])

    def _share(self, time: ca.SX) -> ca.SX:
        def risen(start: float) -> ca.SX:
            x = ca.fmin(ca.fmax((time - start) / self.rise, 0.0), 1.0)
            return x * x * (3.0 - 2.0 * x)

        share = risen(self.start_time)
        return share if self.end_time is None else share - risen(self.end_time)


class AppliedDisturbances(LeafSystem):
    """Applies disturbance forces to the frames of Drake's MultibodyPlant."""

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        plant: MultibodyPlant,
        disturbances: Sequence[DisturbanceForce],
        frames: Sequence[Frame],
    ) -> None:
        super().__init__()
        self.set_name("disturbances")
        self._arguments = plant, disturbances, frames
        self._forces = [each.reference.derivatives([0, 0, 0]) for each in disturbances]
        self._applied = []
        for disturbance, frame in zip(disturbances, frames, strict=True):
            applied = ExternallyAppliedSpatialForce()
            applied.body_index = frame.body().index()
            applied.p_BoBq_B = frame.GetFixedPoseInBodyFrame() @ disturbance.point
            self._applied.append(applied)
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: Value[list[ExternallyAppliedSpatialForce]](),
            weakly(self._calc),
            {self.time_ticket()},
        )

    def again(self) -> "AppliedDisturbances":
        return AppliedDisturbances(*self._arguments)

    def _calc(self, context: Context, output: Value) -> None:
        time = context.get_time()
        for applied, force in zip(self._applied, self._forces, strict=True):
            applied.F_Bq_W = SpatialForce([0.0, 0.0, 0.0], force(time))
        output.set_value(self._applied)
