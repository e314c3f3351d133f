"""The results of the analysis of a system, as values."""

from dataclasses import dataclass
from enum import StrEnum

from drake_dae.analysis.tables import named_values
from drake_dae.arrays import FloatArray
from drake_dae.dae.states.contact_margin import ContactMargin
from drake_dae.dae.states.margins import RankMargin
from drake_dae.dae.states.region import Region
from drake_dae.dae.structure.assumptions import Violation
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.floquet import StabilityAlong
from drake_dae.dae.zero_dynamics.pinned_motion import PinnedMotion
from drake_dae.dae.zero_dynamics.stability import Stability, Verdict


class Finding(StrEnum):
    """The verdicts on an assumption."""

    SATISFIED = "satisfied"
    VIOLATED = "violated"
    UNDECIDED = "not decided"
    NOT_EXAMINED = "not examined"
    FAILS = "does not hold"


@dataclass(frozen=True, eq=False)
class Assumption:
    """One of Assumptions (1)-(5), with the verdict on it.

    Attributes:
        number: The number of the assumption in the paper.
        statement: The requirement, in one line.
        finding: Whether it holds at the examined states and between them.
        margin: The margin of A(x) for (2), and of B(x) for (5); for (1) and (4) where a row of
            these vanishes; else None.
        reason: The violation and its remedy, or why it was not examined; else empty.
        violation: The violation as data; None if the assumption is not violated.
    """

    number: int
    statement: str
    finding: Finding
    margin: RankMargin | None
    reason: str
    violation: Violation | None = None


@dataclass(frozen=True, eq=False)
class Findings:
    """The statements of the theory on one system, as values.

    Values that are not known, since an assumption is violated, are None.

    Attributes:
        system: The system.
        where: A text that says which states were examined.
        region: The requested region; None if there is none.
        states: The states, consistent where the constraints have degrees, shape (samples, n).
        assumptions: Assumptions (1), ..., (5), in this order.
        constraint_degrees: r_1, ..., r_m.
        output_degrees: mu_1, ..., mu_p in the order of the system's outputs.
        independence: Margin of the gradients of all chains, which are linearly independent by
            Theorem 2.1; None also where there are no chains.
        zero_dynamics: Assumption 2.2, by linearization at an equilibrium.
        equilibria: All equilibria of the zero dynamics with the same outputs that were found from
            the examined states.
        zero_dynamics_along: Assumption 2.2 along a periodic reference; None also without one.
        motion: The motion along the reference; None also without one.
        contact_margin: The distance of friction from the Painleve paradox; None without friction.
        contact_margin_along: That distance along the reference; None also without a reference.
        constraint_structure: The structure of the constraints alone, for `DaePlant`; None if A(x)
            is singular at an examined state, or a constraint has no degree.
        structure: The structure, for laws and blocks; None if A(x) or B(x) is singular at an
            examined state. If it is singular only between them, the assumption is violated but
            there is a structure.
    """

    system: DaeSystem
    where: str
    states: FloatArray
    assumptions: tuple[Assumption, ...]
    constraint_degrees: tuple[int, ...] | None = None
    output_degrees: tuple[int, ...] | None = None
    independence: RankMargin | None = None
    zero_dynamics: Stability | None = None
    equilibria: tuple[Stability, ...] = ()
    zero_dynamics_along: StabilityAlong | None = None
    motion: PinnedMotion | None = None
    contact_margin: ContactMargin | None = None
    contact_margin_along: ContactMargin | None = None
    constraint_structure: ConstraintStructure | None = None
    structure: Structure | None = None
    region: Region | None = None

    @property
    def output_order(self) -> tuple[int, ...] | None:
        """The outputs in the paper's order (15): those with mu_i >= 1 first."""
        if self.output_degrees is None:
            return None
        layout = DerivativeLayout(self.output_degrees)
        return (*map(int, layout.dynamic), *map(int, layout.direct))

    @property
    def index(self) -> int | None:
        """max r_i + 1, the index of the DAE; 0 without constraints."""
        degrees = self._degrees_of_manifold
        return None if degrees is None else max(degrees, default=-1) + 1

    @property
    def _degrees_of_manifold(self) -> tuple[int, ...] | None:
        """r_1, ..., r_m, unless Assumption (2) fails, so that they do not add up."""
        violated = self.assumptions[1].finding is Finding.VIOLATED
        return None if violated else self.constraint_degrees

    @property
    def manifold_dimension(self) -> int | None:
        """The dimension of N*, n - sum r_i, Theorem 1.1."""
        degrees = self._degrees_of_manifold
        return None if degrees is None else self.system.num_states - sum(degrees)

    @property
    def zero_dynamics_dimension(self) -> int | None:
        """The dimension of xi in (22), n - sum r_i - sum mu_i."""
        dimension, degrees = self.manifold_dimension, self.output_degrees
        return None if dimension is None or degrees is None else dimension - sum(degrees)

    @property
    def unstable_inside(self) -> tuple[Stability, ...]:
        """Other unstable equilibria inside the requested region."""
        if self.region is None:
            return ()
        return tuple(
            equilibrium
            for equilibrium in self.equilibria
            if equilibrium.verdict is Verdict.UNSTABLE
            and equilibrium is not self.zero_dynamics
            and equilibrium.state is not None
            and self.region.holds(equilibrium.state)
        )

    @property
    def zero_dynamics_finding(self) -> Finding:
        """The verdict on Assumption 2.2.

        Violated if an eigenvalue at rest, or a multiplier, is unstable; otherwise decided along the
        reference if it is periodic, and at rest if not.
        """
        judged = [one.verdict for one in (self.zero_dynamics_along, self.zero_dynamics) if one]
        if not judged:
            return Finding.NOT_EXAMINED
        if Verdict.UNSTABLE in judged or self.unstable_inside:
            return Finding.VIOLATED
        return Finding.SATISFIED if judged[0] is Verdict.STABLE else Finding.UNDECIDED

    @property
    def problems(self) -> tuple[str, ...]:
        """One text for each violation; empty if there are none."""
        sentences = [a.reason for a in self.assumptions if a.finding is Finding.VIOLATED]
        # Where an assumption is violated, the theorem adds nothing.
        if not sentences and self.independence is not None and self.independence.is_singular:
            place = named_values(self.system.state_signals, self.independence.state)
            sentences.append(
                "Theorem 2.1: the gradients of the constraints, the outputs and their derivatives "
                f"depend on each other at {place}"
            )
        # Along a reference the motion decides: elsewhere there may be no contact.
        contact = self.contact_margin_along or self.contact_margin
        if contact is not None and contact.is_paradoxical:
            when = "" if contact.time is None else f"t = {contact.time:.6g} s, "
            critical = ", ".join(f"{k} = {v:.4g}" for k, v in contact.critical_friction.items())
            sentences.append(
                "Friction: the Painleve paradox occurs at "
                f"{when}{named_values(self.system.state_signals, contact.state)}: a principal "
                f"minor of A(x) is {contact.reserve:.3g} of what it is without friction, and "
                f"{critical} is critical there. Lower the friction, slide the other way, or hold "
                "the robot less steeply to the surface"
            )
        for place, judged in (
            ("", self.zero_dynamics),
            ("along the reference ", self.zero_dynamics_along),
        ):
            if judged is not None and judged.verdict is Verdict.UNSTABLE:
                sentences.append(f"Assumption 2.2: {place}{judged.reason}")
        for equilibrium in self.unstable_inside:
            if equilibrium.state is not None:
                place = named_values(self.system.state_signals, equilibrium.state)
                sentences.append(
                    f"Assumption 2.2: inside the region, at rest at {place}: {equilibrium.reason}"
                )
        if self.motion is not None and self.motion.ending is not None:
            sentences.append(str(self.motion.ending))
        return tuple(sentences)
