"""The edges of the surfaces that contacts touch: beyond them there is no contact."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import InconsistentStateError
from drake_dae.systems.blocks.dips import TOUCHING
from drake_dae.systems.plants.pegs.opening import Opening

Beside = tuple[bool, ...]
"""For each contact whether it is beside its face."""


@dataclass(frozen=True, eq=False)
class Feet:
    """The places of the feet of contact points.

    Attributes:
        beside: The contacts that are beside their faces.
        on: For each distance from an edge 1 if the foot is on that side of it, else 0, shape (e,).
    """

    beside: Beside
    on: FloatArray


class Edges:
    """The edges of contacts with surfaces that end, such as a `Plate`.

    The foot of a point is on the face of its surface while all distances e_j(q) of `Surface.edges`
    are positive. A contact exists only in front of the face. It is beside the face when its foot
    passes an edge outward; it is in front of it again when its foot comes onto the face with a gap
    phi >= 0, or when phi rises to zero with the foot on the face. So a point that passes an edge
    below the face stays beside it: the sides of a body are no part of its face, and are contacts of
    their own, if they are declared.

    Distances and gaps within `TOUCHING` count as zero: at an edge itself the direction of the
    motion decides.

    Args:
        dae: The system of the robot.
        openings: All contacts.

    Attributes:
        places: The indices of the contacts with edges.
        size: The number of their distances, e.
    """

    def __init__(self, dae: DaeSystem, openings: Sequence[Opening]) -> None:
        edges = [opening.edges for opening in openings]
        self._name, self._contacts = dae.name, [opening.name for opening in openings]
        self.places = [i for i, own in enumerate(edges) if own.numel()]
        ends = np.cumsum([0, *(edges[i].numel() for i in self.places)]).tolist()
        self.size, self._parts = ends[-1], [slice(*pair) for pair in pairwise(ends)]
        every = ca.vertcat(ca.SX(0, 1), *(edges[i] for i in self.places))
        rate = ca.jtimes(every, dae.state, dae.f) + dae.exogenous.rate(every)
        inside = ca.vertcat(ca.SX(0, 1), *(openings[i].clearance for i in self.places))
        self.function = dae.trace("edges", {"edges": every, "rates": rate})
        self._bodies = dae.trace("bodies", {"clearance": inside}, often=False)

    def __bool__(self) -> bool:
        return bool(self.places)

    def check_outside(self, state: FloatArray, parameters: FloatArray, gaps: FloatArray) -> None:
        """Refuses a start inside a body.

        Args:
            state, parameters: x and the values of the parameters.
            gaps: phi of all contacts.

        Raises:
            InconsistentStateError: A point is inside the surface of its contact, and of a body that
                ends, inside that.
        """
        outside = gaps.copy()
        if self.places:
            outside[self.places] = self._bodies.evaluate(state, parameters)[0]
        deepest = int(np.argmin(outside)) if outside.size else 0
        if outside.size and outside[deepest] < -TOUCHING:
            raise InconsistentStateError(
                f"{self._name}: the start state is {-outside[deepest]:.3g} m inside the surface of "
                f"'{self._contacts[deepest]}'; start outside",
                outside,
            )

    def distances(self, state: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The distances e_j in m, and their rates in m/s, each of shape (e,)."""
        if not self.places:
            return np.zeros(0), np.zeros(0)
        edges, rates = self.function.evaluate(state, parameters)[:2]
        return edges.copy(), rates.copy()

    def feet(
        self,
        state: FloatArray,
        parameters: FloatArray,
        gaps: FloatArray,
        before: Beside | None = None,
    ) -> Feet:
        """The places of the feet.

        Args:
            state, parameters: x and the values of the parameters.
            gaps: phi of all contacts.
            before: The contacts that were beside their faces until now; None before a run.
        """
        edges, rates = self.distances(state, parameters)
        on = (edges > TOUCHING) | ((edges > -TOUCHING) & (rates > 0.0))
        beside = [False] * len(self._contacts)
        for i, part in zip(self.places, self._parts, strict=True):
            was_beside = before is None or before[i]
            beside[i] = not on[part].all() or (was_beside and bool(gaps[i] < -TOUCHING))
        return Feet(tuple(beside), on.astype(float))

    def margins(self, feet: Feet, until: FloatArray, gaps: FloatArray) -> FloatArray:
        """For each contact with edges a number that is positive until its foot passes an edge.

        If the foot is on the face below it, also until the point comes up to the face.

        Args:
            feet: The places of the feet.
            until: The distances of `until_passed`.
            gaps: phi of all contacts.
        """
        margins = np.zeros(len(self.places))
        for row, (i, part) in enumerate(zip(self.places, self._parts, strict=True)):
            margins[row] = until[part].min()
            if feet.beside[i] and feet.on[part].all():
                margins[row] = min(margins[row], -TOUCHING - gaps[i])
        return margins

    def traced_margins(self, beside: ca.SX, on: ca.SX, until: ca.SX, gaps: ca.SX) -> ca.SX:
        """The same as an expression, shape (k, 1) for k contacts with edges."""
        margins = ca.SX(0, 1)
        for i, part in zip(self.places, self._parts, strict=True):
            least = reduce(ca.fmin, ca.vertsplit(until[part]))
            is_below = ca.logic_and(beside[i], reduce(ca.fmin, ca.vertsplit(on[part])) > 0.5)
            margins = ca.vertcat(
                margins, ca.if_else(is_below, ca.fmin(least, -TOUCHING - gaps[i]), least)
            )
        return margins


def until_passed(
    on: FloatArray, edges: FloatArray, rates: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The distances to edges on both sides of them, and their rates, each of shape (e,).

    Args:
        on: As of `Feet`.
        edges, rates: As of `Edges.distances`.
    """
    outward = on < 0.5
    return np.where(outward, TOUCHING - edges, edges), np.where(outward, -rates, rates)
