"""A RobotModel with opening contacts, as a LeafSystem."""

from collections.abc import Collection, Mapping, Sequence
from itertools import product

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    Context,
    EventStatus,
    State,
    UnrestrictedUpdateEvent,
    ValueProducer,
    WitnessFunction,
    WitnessFunctionDirection,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.errors import InconsistentStateError, ModelError, SimulationError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.failures import off_manifold
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import Block, Guard, ones
from drake_dae.systems.plants.contact.contact_material import Peg
from drake_dae.systems.plants.contact_events import ContactChange, ContactEvent
from drake_dae.systems.plants.unilateral.graph import ContactGraph
from drake_dae.systems.plants.unilateral.log import RunLog, clearance, edges_passed
from drake_dae.systems.plants.unilateral.modes import closed_of, numbers_of
from drake_dae.systems.plants.unilateral.ports import ModalPorts
from drake_dae.systems.plants.unilateral.resets import Resets
from drake_dae.systems.plants.unilateral.traced import TracedContacts


@checked(ModelError)
class UnilateralRobotPlant(ModalPorts):
    """A robot (37)-(40) with opening contacts: a system for each set of closed contacts.

    Closed constraints hold as in `RobotPlant`; an open contact has a gap phi > 0 and no force. So
    each contact satisfies phi >= 0, lambda >= 0, phi lambda = 0.

    - It closes where phi falls through zero: an impact, by Newton's law with its coefficient of
      restitution e; several at once by a linear complementarity problem. Bouncing ends by a rule
      that is exact in its limit; see `Resets`. Velocities jump; positions and the states of stages
      do not. Friction also acts in impacts.
    - It opens when lambda falls through zero, or when a jump of the control makes it negative. A
      force that is zero except for round-off, as under a law that leaves none, keeps it closed.
    - On a surface that ends, as a `Plate`, it opens where the foot of its point leaves the face,
      and closes on the face alone; see `Edges`. A peg also has the chamfer, the side and the rim
      of its hole, which the law does not know.
    - With dependent contacts, such as four feet of a table, as few as possible carry the force, and
      the others touch without force. If friction leaves no motion or two, the run ends with a
      PainleveError.

    - A latch, such as a weld, opens and closes by commands. It closes where it is within `capture`
      of its place, with an inelastic impact; its forces have any sign.

    Drake's Simulator finds these times as zeros of witness functions, to within a hundredth of the
    context's accuracy in s under error control, and of a step with fixed steps. So the context's
    accuracy must be set, as `simulate` does: context.SetAccuracy(1e-9) gives 1e-11 s. After each
    step the state is projected onto N* at the start of the next one, as in `DaePlant`.

    Input ports:
        control: u, shape (p,).
        exogenous: The signals w with their derivatives, if the system has any; see
            `ParameterizedSystem`.
        latch: The commands of the latches, if there are any: above 1/2 to be closed, shape (l,).
            All are closed without a wire.

    Output ports:
        state: x, shape (n,).
        mode: For each contact and then each latch 1 if it is closed and 0 if it is open, shape
            (k + l,).
        gap: phi of each contact, m, shape (k,).
        constraint_force: lambda, zero where open, shape (m,).
        constraint_residual: phi_i, phi_i' of each constraint (or nonholonomic rows),
            constraint-major; zero for open contacts.
        controlled_output: z.
        hole_mode, hole_gap, hole_force: With pegs, the same of their contacts with the sides of
            their holes: 1 if it is closed, its gap in m, and its normal force in N.
        link_state: (q, v) of the links, shape (nq + nv,).
        constraint_wrenches: The wrench of each constraint on each of its frames; see `RobotPlant`.

    Stages of actuation add ports for their states and `joint_torque`, as for `RobotPlant`.

    Args:
        model: The robot.
        contacts: Name of a unilateral constraint -> its coefficient of restitution, 0 (no bounce)
            to 1 (no loss). It becomes the parameter "<name>.restitution".
        settling_time: Bouncing that would end within this time, in s, ends at once; positive.
        structure: The structure of `model.dae`, with all contacts closed; found if None.
        latches: The names of bilateral constraints that open and close by commands.
        capture: The largest distance in m, or angle in rad, at which a latch closes.
        latch_sets: The sets of latches that a run closes together, for rollouts and exports; all
            sets if empty.
        pegs: The pegs with which it enters holes of a `Plate`, each at a contact of `contacts` and
            with its coefficients of restitution and friction. Radius and axis count here, and no
            balls; see `PegInHole`.

    Attributes:
        model: The robot.
        contacts: The names of the contacts and latches, in the order of `mode`.
        latches: The argument.
        modes: The closed contacts -> the motion then; see `Mode`.
        gap_signals: Names and units of `gap`.
        mode_signals: Names of `mode`.
        normals: The index of the normal force of each contact in `constraint_force`.
        wrench_signals: Names and units of `constraint_wrenches`.

    Raises:
        ModelError: A constraint is not known, or cannot open, or a number is not valid.
        InconsistentStateError: A simulation starts off the bilateral constraints, or inside a
            surface.
        AssumptionError: The constraints of a mode are dependent.
        SimulationError: No forces fit, impacts do not end or 1000 events follow each other within
            1e-6 s, a latch is commanded to close too far from its place, or the context has no
            accuracy.
        PainleveError: The Painleve paradox: a contact with no motion, or two.
    """

    __slots__ = SHARED_DICTIONARY
    projects = True

    def __init__(
        self,
        model: RobotModel,
        contacts: Mapping[str, float],
        *,
        settling_time: float = 1e-3,
        structure: ConstraintStructure | None = None,
        latches: Sequence[str] = (),
        capture: float = 1e-3,
        latch_sets: Collection[Collection[str]] = (),
        pegs: Sequence[Peg] = (),
    ) -> None:
        settling = positive(f"{model.name}: settling_time", settling_time)
        super().__init__(model, contacts, structure, latches, pegs)
        captured = positive(f"{model.name}: capture", capture)
        self._latch_sets = [
            tuple(name in closed for name in self.latches) for closed in latch_sets
        ] or list(product((False, True), repeat=len(self.latches)))
        self._edges = self._contacts.edges
        self._resets = Resets(self._contacts, self.modes, settling, captured)
        self._log_index = self.DeclareCacheEntry(
            "events",
            ValueProducer(lambda: AbstractValue.Make(RunLog()), _keep),
            {self.nothing_ticket()},
        ).cache_index()
        self._margins_index = self.DeclareCacheEntry(
            "margins",
            ValueProducer(lambda: AbstractValue.Make(np.zeros(0)), weakly(self._calc_margins)),
            self._by_control | self._by_latch,
        ).cache_index()
        self.DeclareInitializationUnrestrictedUpdateEvent(weakly(self._start))
        self.DeclarePerStepUnrestrictedUpdateEvent(weakly(self._advance))
        every = self._contacts.every
        guards = [
            *(("gap, force or command", self._guard, i) for i in range(len(every))),
            *(("edge", self._edge_guard, i) for i in self._edges.places),
        ]
        self._witnesses = [
            self.MakeWitnessFunction(
                f"{every[place]}: {text}",
                WitnessFunctionDirection.kPositiveThenNonPositive,
                weakly(guard, place),
                UnrestrictedUpdateEvent(weakly(self._at_guard)),
            )
            for text, guard, place in guards
        ]

    def events(self, context: Context) -> tuple[ContactEvent, ...]:
        """The events of contacts since the start of the run of a context."""
        self.check_context(context)
        return tuple(self._log(context).events)

    @property
    def graph(self) -> ContactGraph:
        """Modes, guards and resets: print it, or draw its `graphviz()`."""
        names = self._contacts.names
        return ContactGraph(self.dae.name, names, tuple(names[i] for i in self._edges.places))

    def DoGetWitnessFunctions(self, context: Context) -> list[WitnessFunction]:
        return self._witnesses

    def _log(self, context: Context) -> RunLog:
        # The object is not replaced, and is changed in place.
        log: RunLog = self.get_cache_entry(self._log_index).Eval(context)
        return log

    def _guard(self, place: int, context: Context) -> float:
        """Positive while a contact keeps its mode: Drake locates the zero."""
        margin, log = float(self._margins(context)[place]), self._log(context)
        closed = self._numbers(context)[place] > 0.5
        is_latch = place >= len(self._contacts.names)
        if not (closed or is_latch) or context.get_time() != log.time:
            return -1.0 if place in log.pulled else margin
        # After a jump of a sampled control the force may be negative from the start of a step on;
        # and after an event a command may differ from the mode.
        # Drake sees a zero only if the sign was different at the start, and the force may be
        # positive again at the end of the step.
        if margin <= 0.0 and log.held:
            log.pulled.add(place)
        return margin if margin > 0.0 else 1.0

    def _edge_guard(self, place: int, context: Context) -> float:
        """Positive until the foot of a contact passes an edge."""
        return float(
            self._margins(context)[len(self._contacts.every) + self._edges.places.index(place)]
        )

    def _margins(self, context: Context) -> FloatArray:
        """For each contact its `grip` if closed; otherwise positive until it penetrates its face.

        For each latch positive while it is as it is commanded; then those of edges, see `Edges`.
        """
        margins: FloatArray = self.get_cache_entry(self._margins_index).Eval(context)
        return margins

    def _calc_margins(self, context: Context, value: AbstractValue) -> None:
        on, count = self._numbers(context) > 0.5, len(self._contacts.names)
        closed, latched = on[:count], on[count:]
        margins, further = np.zeros(closed.size), np.zeros(0)
        log, time = self._log(context), context.get_time()
        if not closed.all() or self._edges:
            state = context.get_continuous_state_vector().value()
            gaps, rates = self._checked(self._contacts.gaps, context, state)
            margins = clearance(log, time, gaps, rates)
            if self._edges:
                feet = self._feet(context)
                margins[np.flatnonzero(feet.beside)] = 1.0
                away, speeds = self._checked(self._edges.function, context, state)
                until = edges_passed(log, time, feet.on, away, speeds)
                further = self._edges.margins(feet, until, gaps)
        if closed.any():
            grip = self._evaluate(self._mode(context).grip, context)
            margins[closed] = grip[self._contacts.normals][closed]
        as_commanded = latched == self._commanded(context) if latched.size else latched
        every = np.concatenate([margins, np.where(as_commanded, 1.0, -1.0), further])
        log.note(time, every)
        value.set_value(every)

    def _at_guard(
        self, context: Context, event: UnrestrictedUpdateEvent, state: State
    ) -> EventStatus:
        return self._advance(context, state)

    def _start(self, context: Context, state: State) -> EventStatus:
        log, now = self._log(context), context.get_time()
        # For a run that is continued.
        earlier = [event for event in log.events if event.time < now]
        vars(log).update(vars(RunLog(events=earlier, time=now)))
        if context.get_accuracy() is None:
            raise SimulationError(
                f"{self.dae.name}: the context has no accuracy, and without one Drake does not "
                "seek the times at which contacts open and close; call context.SetAccuracy(1e-10)",
                context.get_time(),
                self.state(context),
            )
        x, values = self.state(context), self._values(context)
        self.modes.check_start(x, values)
        if np.isnan(self._control(context)).any():
            # Values held between samples change with this event, at the start of the first step.
            log.waits = True
            closed, feet = self._resets.resting(x, values, self._commanded(context))
            state.get_mutable_discrete_state().set_value(numbers_of(closed, feet))
            self._begin_step(context, x, values)
            return EventStatus.Succeeded()
        status = self._reset(context, state, starts=True)
        # A closed contact at the start is not an event.
        log.events = [
            event
            for event in log.events
            if event.time < now or event.kind is not ContactChange.CLOSING
        ]
        return status

    def _advance(self, context: Context, state: State) -> EventStatus:
        log = self._log(context)
        log.time, waits, log.waits = context.get_time(), log.waits, False
        x, values = self.state(context), self._values(context)
        log.held = log.begin(self.dae.name, self._margins(context), x) and not waits
        if not log.held:
            return self._reset(context, state)
        try:
            x = self._mode(context).structure.manifold.projected(x, values)
        except InconsistentStateError as error:
            raise off_manifold(context.get_time(), x, error) from error
        state.get_mutable_continuous_state().SetFromVector(x)
        self._begin_step(context, x, values)
        return EventStatus.Succeeded()

    def _begin_step(self, context: Context, state: FloatArray, values: FloatArray) -> None:
        """Stores the start of a step."""
        log = self._log(context)
        log.gaps, log.rates = (v.copy() for v in self._contacts.gaps.evaluate(state, values))
        log.edges, log.edge_rates = self._edges.distances(state, values)

    def _reset(self, context: Context, state: State, starts: bool = False) -> EventStatus:
        closed = closed_of(self._numbers(context))
        beside = None if starts else self._feet(context).beside
        time, x, values = context.get_time(), self.state(context), self._values(context)
        try:
            x = self._mode(context).structure.manifold.projected(x, values)
            e = context.get_numeric_parameter(1).value()[self._contacts.restitution_of]
            latched = self._commanded(context)
            control = self._control(context)
            after = self._resets(time, x, closed, control, values, e, latched, beside)
        except InconsistentStateError as error:
            raise off_manifold(time, x, error) from error
        log, before = self._log(context), (time, x.tobytes())
        log.count(self.dae.name, time, x)
        if log.before != before:  # Several guards may trigger at the same time.
            log.before = before
            log.events += after.events
        state.get_mutable_continuous_state().SetFromVector(after.state)
        state.get_mutable_discrete_state().set_value(numbers_of(after.closed, after.feet))
        self._begin_step(context, after.state, values)
        return EventStatus.Succeeded()

    def _react(self, context: Context, state: State) -> EventStatus:
        self._log(context).time = context.get_time()
        return self._reset(context, state)

    def traced(self) -> Block:
        traced, dae = (
            TracedContacts(self._contacts, self.modes, self._residual, self._latch_sets),
            self.dae,
        )
        return Block(
            self,
            traced.computations(self._ports),
            check_start=self.modes.check_start,
            projection=traced.projection(),
            scale=dae.scale,
            moving=tuple(self.exogenous_places),
            guard=Guard(traced.guard(), self._react),
            unwired={} if self._latch_port is None else {"latch": ones("latch", len(self.latches))},
            signals=self._signals,
            ports={
                **self.port_signals,
                **{name: tuple(signals) for name, signals in self.further_signals.items()},
                "constraint_wrenches": tuple(self.wrench_signals),
            },
        )


def _keep(context: Context, value: AbstractValue) -> None:
    """The log of a context is never invalidated."""
