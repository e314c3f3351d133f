"""The opening contacts of a robot, and their matrices at a state."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, number, show, unknown_name
from drake_dae.dae.system.contacts import PainleveOutcome, painleve_outcome
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, PainleveError, SimulationError
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.model import RobotModel
from drake_dae.systems.plants.contact.contact_material import Peg
from drake_dae.systems.plants.pegs.hole import openings_of
from drake_dae.systems.plants.pegs.opening import with_openings
from drake_dae.systems.plants.unilateral.edges import Edges
from drake_dae.systems.plants.unilateral.frictional import FrictionalContact
from drake_dae.systems.plants.unilateral.impacts import TouchRows, is_p_matrix


@dataclass(frozen=True, eq=False)
class ConstraintTerms:
    """The rates, accelerations and matrices of all constraints at one state.

    Attributes:
        all_rates: The rates c of the constraints, phi' or nonholonomic rows, then the sliding
            velocities of frictional contacts, shape (m + s,).
        accelerations: c' without constraint forces.
        force_matrix: The matrix of constraint forces in c', shape (m, m).
        all_impulses: The matrix of impulses in `all_rates`, shape (m + s, m + s).
        velocity_change: The matrix of impulses in x, shape (n, m + s).
        size: The sizes of the terms of `accelerations`.
    """

    all_rates: FloatArray
    accelerations: FloatArray
    force_matrix: FloatArray
    all_impulses: FloatArray
    velocity_change: FloatArray
    size: FloatArray

    @property
    def rates(self) -> FloatArray:
        """Those of the constraints alone, shape (m,)."""
        return self.all_rates[: self.accelerations.size]

    @property
    def impulse_matrix(self) -> FloatArray:
        """The matrix of impulses of constraints in their rates, shape (m, m)."""
        m = self.accelerations.size
        return self.all_impulses[:m, :m]

    def painleve_outcome(
        self, bilateral: Sequence[int], normals: Sequence[int]
    ) -> PainleveOutcome | None:
        """The outcome of a Painleve paradox of touching contacts; None if one set of forces fits.

        Args:
            bilateral: The bilateral rows.
            normals: The rows of the contacts.
        """
        rows = [*bilateral, *normals]
        part = np.ix_(rows, rows)
        matrix, without, offset = (
            self.force_matrix[part],
            self.impulse_matrix[part],
            self.accelerations[rows],
        )
        places = list(range(len(bilateral), len(rows)))
        if is_p_matrix(matrix, without, places):
            return None
        force = np.full(len(rows), np.inf)
        with suppress(np.linalg.LinAlgError):
            force[:] = np.linalg.solve(matrix, -offset)
        return painleve_outcome(matrix, without, force, self.size[rows], places)


class UnilateralContacts:
    """The constraints of a robot that open and close: contacts by themselves, latches by commands.

    Args:
        model: The robot.
        restitution: Name of a constraint -> its coefficient of restitution e, 0 to 1.
        latches: The names of holonomic bilateral constraints.
        pegs: The pegs, whose contacts with their holes follow those of the model's constraints.

    Attributes:
        names: The names of the contacts, in the order of the model's constraints, then of pegs.
        openings: The contacts.
        shown: The names of those of the model's constraints.
        latches: The argument.
        every: The names of contacts and latches, in the order of a mode.
        latch_rows: The rows of each latch.
        dae: The system with all contacts closed; that of the model is `of_model`.
        restitution: e of each contact of the model's constraints, shape (k,).
        restitution_of: The place in `restitution` for each contact.
        touches: The rows of each contact.
        along: The rows of the sliding velocities of each contact in `all_rates`.
        bilateral: The rows of all other constraints.
        normals: The normal row of each contact.
        edges: The edges of their surfaces.
        gaps: A function of state and parameters: phi of each contact, and phi'.
        rates: The rates of all constraints, shape (m, 1), and `drift`, the part of their
            derivatives from exogenous signals.
        residual: phi_i, phi_i' of each constraint of the model, or nonholonomic rows; `sizes` are
            the numbers of entries.

    Raises:
        ModelError: There is no such constraint, or it is not unilateral, or not fit for a latch.
    """

    def __init__(
        self,
        model: RobotModel,
        restitution: Mapping[str, float],
        latches: Sequence[str] = (),
        pegs: Sequence[Peg] = (),
    ) -> None:
        parts = {c.name: (c, part) for c, part in ConstraintSet(model.constraints).parts()}
        fitting = [
            name
            for name, (constraint, _) in parts.items()
            if sum(constraint.is_unilateral) == 1
            and constraint.is_unilateral.index(True) < constraint.residual(model.links).numel()
        ]
        if not restitution and not latches:
            raise ModelError(
                f"{model.name}: no opening contacts are given; possible ones are {fitting}. If no "
                "contact opens, use a RobotPlant"
            )
        for name in restitution:
            if name not in parts:
                raise ModelError(f"{model.name}: {unknown_name('constraint', name, parts)}")
            if name not in fitting:
                raise ModelError(
                    f"{model.name}: '{name}' cannot open, since it is not unilateral with a "
                    f"single force; those that are: {fitting}"
                )
        if model.dae.sharing is not None:
            raise ModelError(
                f"{model.name}: redundant constraints share their forces, which contacts that open "
                "and close cannot; leave `compliances` out"
            )
        self.shown = tuple(name for name in parts if name in restitution)
        if latches and pegs:
            raise ModelError(f"{model.name}: a robot with latches has no pegs in ideal contact")
        openings, self.restitution_of = openings_of(model, self.shown, pegs)
        self.names = tuple(openings)
        self.openings = tuple(openings.values())
        self.of_model = model.dae
        self.dae = dae = with_openings(model, self.openings[len(self.shown) :])
        self.touches = [_touch_rows(*parts[name]) for name in self.shown]
        further = range(model.dae.num_constraints, dae.num_constraints)
        self.touches += [TouchRows(row, np.array([row])) for row in further]
        self.latches, self.every = tuple(latches), (*self.names, *latches)
        self.latch_rows = [_latch_rows(model, parts, name) for name in latches]
        opening = [*(touch.rows for touch in self.touches), *self.latch_rows]
        self.bilateral: Indices = np.setdiff1d(
            np.arange(dae.num_constraints), np.concatenate(opening)
        )
        self.normals = [touch.normal for touch in self.touches]
        self.restitution = np.array(
            [coefficient(f"{model.name}: {n}.restitution", restitution[n]) for n in self.shown],
            dtype=float,
        )
        links = model.links
        rate = ca.jtimes(dae.k, dae.state, dae.f) + dae.exogenous.rate(dae.k)
        by_velocity = [ca.depends_on(row, links.v) for row in ca.vertsplit(dae.k)]
        pairs = zip(ca.vertsplit(dae.k), ca.vertsplit(rate), by_velocity, strict=True)
        held = [(k,) if moves else (k, slope) for k, slope, moves in pairs]
        self.rates = ca.vertcat(ca.SX(0, 1), *(rows[-1] for rows in held))
        self.drift = dae.exogenous.rate(self.rates)
        self.sizes = [len(rows) for rows in held[: model.dae.num_constraints]]
        every_row = [row for rows in held for row in rows]
        self.residual = ca.vertcat(ca.SX(0, 1), *every_row[: sum(self.sizes)])
        self.gaps = dae.trace(
            "gaps", {"gap": dae.k[self.normals], "rate": self.rates[self.normals]}
        )
        self.edges = Edges(dae, self.openings)
        self.off = dae.trace("latches", {"value": dae.k}) if latches else None
        positions, velocities = links.q.numel(), links.v.numel()
        self._moved = slice(positions, positions + velocities)
        slides = [opening.sliding for opening in self.openings]
        ends = dae.num_constraints + np.cumsum([0, *(each.numel() for each in slides)])
        self.along: list[Indices] = [np.arange(*pair) for pair in pairwise(ends)]
        self._friction = [
            dae.parameter_slice(opening.friction).start if opening.friction else None
            for opening in self.openings
        ]
        every = ca.vertcat(self.rates, *slides)
        control = ca.SX.sym("u", dae.num_controls)
        self._control = bool(dae.num_controls)
        self._terms = dae.trace(
            "contacts",
            {
                "rates": every,
                "slope": ca.jacobian(every, dae.state),
                "drift": self.drift,
                "mass": dae.mass_matrix,
                "free": dae.f + ca.mtimes(dae.h, control),
                "force": dae.g,
            },
            {"control": control},
            often=False,
        )

    def frictional_contact(
        self, place: int, parameters: FloatArray, restitution: float
    ) -> FrictionalContact:
        """The friction of a contact in an impact.

        Further rows that restrict its velocities, such as sticking, hold while it has a normal
        impulse.
        """
        touch, mu = self.touches[place], self._friction[place]
        others = touch.rows[touch.rows != touch.normal]
        if mu is None or others.size:
            return FrictionalContact(touch.normal, others, np.inf, restitution)
        return FrictionalContact(
            touch.normal, self.along[place], float(parameters[mu]), restitution
        )

    def rows(self) -> list[Indices]:
        """The rows of each contact and latch."""
        return [*(touch.rows for touch in self.touches), *self.latch_rows]

    def bilateral_in(self, closed: Sequence[bool]) -> Indices:
        """The rows of all bilateral constraints that hold in a mode.

        Args:
            closed: The closed contacts and latches, one flag for each.
        """
        shut = zip(self.latch_rows, closed[len(self.names) :], strict=True)
        return np.concatenate([self.bilateral, *(rows for rows, is_shut in shut if is_shut)])

    def check_capture(
        self, place: int, time: float, state: FloatArray, parameters: FloatArray, capture: float
    ) -> None:
        """Refuses a latch that closes too far from its place.

        Raises:
            SimulationError: A distance or angle of the latch is larger than `capture`.
        """
        assert self.off is not None
        values = self.off.evaluate(state, parameters)[0]
        off = float(np.max(np.abs(values[self.latch_rows[place]])))
        if not off <= capture:
            raise SimulationError(
                f"{self.dae.name}: the latch '{self.latches[place]}' is commanded to close at t = "
                f"{time:.6g} s, and is {off:.3g} m or rad off its place, more than its capture of "
                f"{capture:g}. Lead it nearer before it closes",
                time,
                state.copy(),
            )

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        """Names and units of `residual`."""
        signals = list[Signal]()
        for signal, size in zip(self.of_model.constraint_output_signals, self.sizes, strict=True):
            signals += [signal, signal.derivative(1)][:size]
        return tuple(signals)

    def holds(self, closed: Sequence[bool]) -> FloatArray:
        """For each entry of the residual 1, or 0 if its contact is open."""
        rows = np.ones(self.dae.num_constraints)
        for own, shut in zip(self.rows(), closed, strict=True):
            rows[own] = shut
        return np.repeat(rows[: len(self.sizes)], self.sizes)

    def terms(
        self, state: FloatArray, control: FloatArray, parameters: FloatArray
    ) -> ConstraintTerms:
        """The numbers at a state; nan where a function has no value."""
        values = self._terms.evaluate(state, control, parameters)
        n, m = state.size, self.dae.num_constraints
        rates, slope, drift, mass, free, force = (value.copy() for value in values)
        slope, mass, force = slope.reshape(-1, n), mass.reshape(n, n), force.reshape(n, m)
        push = np.zeros((n, rates.size))
        push[self._moved] = slope[:, self._moved].T
        try:
            solved = np.asarray(np.linalg.solve(mass, np.column_stack([free, force, push])), float)
        except np.linalg.LinAlgError:
            solved = np.full((n, 1 + m + rates.size), np.nan)
        moved = slope @ solved
        return ConstraintTerms(
            all_rates=rates,
            accelerations=moved[:m, 0] + drift,
            force_matrix=moved[:m, 1 : m + 1],
            all_impulses=moved[:, m + 1 :],
            velocity_change=solved[:, m + 1 :],
            size=np.abs(slope[:m]) @ np.abs(solved[:, 0]) + np.abs(drift),
        )

    def painleve_error(
        self, time: float, state: FloatArray, names: Sequence[str], outcome: PainleveOutcome | None
    ) -> PainleveError:
        """The error of a Painleve paradox."""
        remark = f". Its outcome is {outcome.value}" if outcome else ""
        return PainleveError(
            f"{self.dae.name}: Painleve paradox at the contact of {', '.join(names)} at "
            f"t = {time:.6g} s, state {show(state)}{remark}. Lower the friction, slide the other "
            "way, or hold the robot less steeply to the surface",
            time,
            state,
            outcome,
        )


def _touch_rows(constraint: Constraint, part: slice) -> TouchRows:
    normal = part.start + constraint.is_unilateral.index(True)
    return TouchRows(normal, np.arange(part.start, part.stop))


def _latch_rows(
    model: RobotModel, parts: Mapping[str, tuple[Constraint, slice]], name: str
) -> Indices:
    """The rows of a latch.

    Raises:
        ModelError: There is no such constraint, or it is unilateral or nonholonomic.
    """
    if name not in parts:
        raise ModelError(f"{model.name}: {unknown_name('constraint', name, parts)}")
    constraint, part = parts[name]
    rows = np.arange(part.start, part.stop)
    if any(constraint.is_unilateral) or constraint.residual(model.links).numel() < rows.size:
        raise ModelError(
            f"{model.name}: '{name}' cannot be a latch, since it only pushes, or restricts "
            "velocities; use a bilateral constraint such as WeldedFrames or CoincidentPoints"
        )
    return rows


def coefficient(name: str, value: float) -> float:
    """A coefficient of restitution.

    Raises:
        ModelError: It is none.
    """
    e = number(name, value)
    if not 0.0 <= e <= 1.0:
        raise ModelError(f"{name} must be between 0, no bounce, and 1, no loss; got {e:g}")
    return e
