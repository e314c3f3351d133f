"""What leads through the phases of a task: guards, changes and references."""

from dataclasses import replace

import casadi as ca
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
    UnrestrictedUpdateEvent,
    WitnessFunction,
    WitnessFunctionDirection,
)

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import SimulationError
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import Block, Computation, Guard, Update
from drake_dae.systems.control.contract import SIGNAL
from drake_dae.systems.task.phases import Moment
from drake_dae.systems.task.phases.phase import FAIL, LEAVE, STOP
from drake_dae.systems.task.planner import CONTACT, FREE, ModelMoment, PhaseCause, TaskPlanner
from drake_dae.systems.task.progress import ReferenceSegment, TaskProgress
from drake_dae.systems.task.sight import PhaseDecision
from drake_dae.systems.task.task import Task
from drake_dae.systems.task.traced import EARLY, SEEN, TracedTask


class TaskSupervisor(LeafSystem):
    """Leads through the phases of a task; see `TaskController`.

    Input ports:
        estimated_state: x, shape (n,).
        measured_force: All constraint forces, shape (m,).
        hold: Where it is not 0, the law's integrals stand still, shape (1,); 0 without a wire.
        control: u, shape (p,); where a guard watches it.
        signal_<name>: Those for which phases wait, shape (1,); 0 without a wire.

    Output ports:
        contact_reference, free_reference: R of the law that acts, zero for the other one.
        phase: The place of the phase, shape (1,); their number when done or held.
        desired_output: The positions, the force and the distance that are wanted, shape (p + 1,);
            zero for the one of the last two that is none now.
        in_contact: 1 where the law in contact acts, shape (1,).
        contact_hold, free_hold: Where it is 1, the law's integrals stand still, shape (1,): while
            the other law acts, no force is felt, the robot has just touched, or `hold` says so.
        tared_force: The measured forces less the bias that was found, shape (m,); with a tare_time.

    Args:
        task: The phases.
        laws: The law of the free robot and that in contact.
        place: Which output is the distance of the first, and the force of the second.
        force: Which entry of `measured_force` is the contact's.
        sample_period: When guards are looked at, in s; 0 for at all times.

    Attributes:
        signal_ports: Name of a signal -> its input port.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        task: Task,
        laws: tuple[TrackingLaw, TrackingLaw],
        place: int,
        force: int,
        num_forces: int,
        sample_period: float,
    ) -> None:
        super().__init__()
        self.set_name("task")
        self._sample_period = sample_period
        self.task, self._laws, self._place, self._force = task, laws, place, force
        self._phases, self._plan = task.plan.phases, TaskPlanner(task, laws, place)
        self._traced = TracedTask(task, laws, place, force, self._plan, num_forces, sample_period)
        system = laws[FREE].system
        self._state_port = self.DeclareVectorInputPort("estimated_state", system.num_states)
        self._force_port = self.DeclareVectorInputPort("measured_force", num_forces)
        self._hold_port = self.DeclareVectorInputPort("hold", 1)
        declared, self._control_port = self.DeclareVectorInputPort, None
        if task.watches("control"):
            self._control_port = declared("control", system.num_controls)
        self.signal_ports = {name: declared(SIGNAL + name, 1) for name in task.signals}
        self.DeclareNumericParameter(BasicVector(system.parameter_values))
        self._index = self.DeclareAbstractState(AbstractValue.Make(TaskProgress()))
        self._held = self.DeclareDiscreteState(self._traced.size)
        self.DeclareInitializationUnrestrictedUpdateEvent(weakly(self._begin))
        self._witnesses: list[WitnessFunction] = []
        if sample_period > 0.0:
            self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._advance))
        else:
            self.DeclarePerStepUnrestrictedUpdateEvent(weakly(self._advance))
            self._witnesses.append(
                self.MakeWitnessFunction(
                    "the end of the phase",
                    WitnessFunctionDirection.kPositiveThenNonPositive,
                    weakly(self._guard),
                    UnrestrictedUpdateEvent(weakly(self._at_guard)),
                )
            )
        self._declare_outputs()

    def _declare_outputs(self) -> None:
        # Before a run it is as if the first phase began at the state that there is.
        by_state = {
            self.abstract_state_ticket(self._index),
            self.input_port_ticket(self._state_port.get_index()),
            self.all_parameters_ticket(),
        }
        by_time = by_state | {self.time_ticket()}
        seen = {
            self.input_port_ticket(self._force_port.get_index()),
            self.discrete_state_ticket(self._held),
        }
        names = {FREE: "free_reference", CONTACT: "contact_reference"}
        for which, name in names.items():
            size = self._laws[which].layout.reference_size
            self.DeclareVectorOutputPort(name, size, weakly(self._calc_reference, which), by_time)
        size = self._laws[FREE].system.num_outputs + 1
        self.DeclareVectorOutputPort("desired_output", size, weakly(self._calc_desired), by_time)
        self.DeclareVectorOutputPort("phase", 1, weakly(self._calc_phase), by_state)
        self.DeclareVectorOutputPort("in_contact", 1, weakly(self._calc_in_contact), by_state)
        hold = self.input_port_ticket(self._hold_port.get_index())
        for name, calc, tickets in (
            ("free_hold", self._calc_free_hold, by_state),
            ("contact_hold", self._calc_contact_hold, by_time | seen),
        ):
            self.DeclareVectorOutputPort(name, 1, weakly(calc), tickets | {hold})
        if self.task.tare_time:
            size = self._force_port.size()
            self.DeclareVectorOutputPort("tared_force", size, weakly(self._calc_tared), seen)

    def progress(self, context: Context) -> TaskProgress:
        """How far the task is, in a context of this system."""
        found: TaskProgress = context.get_abstract_state(self._index).get_value()
        return found

    def desired(self, segment: ReferenceSegment, time: float) -> FloatArray:
        """The positions, the force and the distance that a segment wants at a time in s."""
        values = segment.reference(time)[segment.layout.lowest]
        found = np.append(values, 0.0)
        if not segment.change.in_contact:
            found[-1], found[self._place] = values[self._place], 0.0
        return found

    def DoGetWitnessFunctions(self, context: Context) -> list[WitnessFunction]:
        return self._witnesses

    def _now(self, context: Context) -> ModelMoment:
        parameters = context.get_numeric_parameter(0).CopyToVector()
        return ModelMoment(context.get_time(), self._state_port.Eval(context), parameters)

    def _segment(self, context: Context) -> ReferenceSegment:
        """The references that hold now."""
        progress = self.progress(context)
        return progress.segments[-1] if progress.segments else self._plan.first(self._now(context))

    # What ends a phase.

    def _moment(self, context: Context, segment: ReferenceSegment) -> Moment:
        time = context.get_time()
        force = float(self._seen(context)[0])
        distance, rate, moved, rates = self._plan.motion(self._now(context))
        wanted = segment.reference(time)[segment.layout.lowest[self._place]]
        passed, away = time - segment.change.time, distance - segment.change.distance
        control, signal = 0.0, 0.0
        if self._control_port is not None:
            control = float(np.abs(self._control_port.Eval(context)).max())
        if segment.change.place < len(self._phases):
            name = self._phases[segment.change.place].signal
            if name and self.signal_ports[name].HasValue(context):
                signal = float(self.signal_ports[name].Eval(context)[0])
        work = self._traced.work_of(context.get_discrete_state(self._held).value())
        gone = float(np.linalg.norm(rates)), float(np.linalg.norm(moved - segment.origin))
        seen = passed, force, distance, rate, float(wanted), away
        return Moment(*seen, *gone, work, control, signal)

    def _seen(self, context: Context) -> FloatArray:
        """What is seen of the force with the present sample: see `SEEN`."""
        held = context.get_discrete_state(self._held).value()
        return self._traced.seen(held, float(self._force_port.Eval(context)[self._force]))

    def _sight(self, context: Context, progress: TaskProgress) -> PhaseDecision:
        task, segment = self.task, progress.segments[-1]
        moment, over = self._moment(context, segment), self._is_over(segment)
        excess, lost, end, late = moment.force - task.contact_force, np.inf, np.inf, np.inf
        phase = None if over else self._phases[segment.change.place]
        holds = phase is None or phase.holds_contact
        if holds and segment.change.in_contact and not progress.is_felt:
            lost = task.patience - (context.get_time() - progress.felt)
        held = context.get_discrete_state(self._held).value()
        guards = np.full(1, np.inf)
        if phase is not None:
            late = float(phase.remaining(moment))
            if not self._traced.tares(held):
                end = float(phase.margin(moment, task.contact_force))
            tally = self._traced.tally_of(held)
            found = self._traced.tally.margins(phase, tally, moment)
            guards = np.array([np.inf, *map(float, found)])[-max(len(found), 1) :]
        felt = excess if progress.is_felt else -excess
        return PhaseDecision(moment, guards, np.array([np.min(guards), end, lost, late, felt]))

    def _guard(self, context: Context) -> float:
        """Positive while the phase goes on: Drake seeks where that ends."""
        progress = self.progress(context)
        if not progress.segments:
            return 1.0
        margins = self._sight(context, progress).margins
        # A little early: Drake's Simulator ends the process where it finds a zero at the very end
        # of a step at which a sample is due.
        least = float(np.min(margins)) - EARLY
        # What jumped with an event, as the force of an impact, is seen only if it was not so at the
        # start of a step.
        return 1.0 if least <= 0.0 and context.get_time() == progress.step else least

    def _is_over(self, segment: ReferenceSegment) -> bool:
        return segment.change.place >= len(self._phases)

    def _begin(self, context: Context, state: State) -> EventStatus:
        if self.progress(context).segments:
            return EventStatus.DidNothing()  # A run that goes on.
        time = context.get_time()
        if context.get_discrete_state_vector().value().any():
            raise SimulationError(
                f"{self.get_name()}: a task begins when its run does: what it did before is not "
                "among the numbers of a start",
                time,
                self._state_port.Eval(context).copy(),
            )
        progress = TaskProgress((self._segment(context),), time - self._sample_period, time)
        self._put(state, progress, np.zeros(len(SEEN)), np.zeros(self._traced.tally.size))
        return EventStatus.Succeeded()

    def _at_guard(
        self, context: Context, event: UnrestrictedUpdateEvent, state: State
    ) -> EventStatus:
        return self._advance(context, state)

    def _advance(self, context: Context, state: State) -> EventStatus:
        progress, time = self.progress(context), context.get_time()
        if self._sample_period and time == progress.step:
            return EventStatus.DidNothing()  # A run that goes on begins with the last sample.
        force, seen = self._seen(context), self._sight(context, progress)
        status, found = EventStatus.Succeeded(), progress.segments
        tally, place = np.zeros(self._traced.tally.size), found[-1].change.place
        if seen.ends:
            following, status = self._changed(context, progress, seen)
            found = (*found, following)
        elif tally.size and place < len(self._phases):
            before = self._traced.tally_of(context.get_discrete_state(self._held).value())
            after = self._traced.tally.after(self._phases[place], before, seen.moment)
            tally = np.array([float(one) for one in after])
        is_felt, felt = progress.is_felt != seen.turns, time if progress.is_felt else progress.felt
        now = replace(progress, segments=found, step=time, is_felt=is_felt, felt=felt)
        self._put(state, now, force, tally)
        return status

    def _put(
        self, state: State, progress: TaskProgress, seen: FloatArray, tally: FloatArray
    ) -> None:
        state.get_mutable_abstract_state().get_mutable_value(int(self._index)).set_value(progress)
        state.get_mutable_discrete_state().set_value(self._traced.numbers(progress, seen, tally))

    def _changed(
        self, context: Context, progress: TaskProgress, seen: PhaseDecision
    ) -> tuple[ReferenceSegment, EventStatus]:
        """What follows where a phase has ended."""
        segment, now, moment = progress.segments[-1], self._now(context), seen.moment
        if self._is_over(segment):
            cause = PhaseCause("the contact is lost at rest", segment.change.chosen, True)
            following = self._plan.following(now, segment, moment, None, cause)
            return following, EventStatus.Succeeded()
        place = segment.change.place
        outcome, reason = seen.outcome(self._phases[place], self.task.contact_force)
        changes = progress.changes
        entered, chosen = [one.place for one in changes], [one.chosen for one in changes]
        after = self.task.plan.successor(place, outcome, entered, chosen)
        reason = ", ".join(filter(None, (reason, after.remark)))
        if after.chosen == FAIL:
            raise seen.failure(reason, now.time, now.state)
        status = EventStatus.Succeeded()
        if after.place is None and after.chosen in (STOP, LEAVE):
            status = EventStatus.ReachedTermination(self, reason)
        leaves = place >= self.task.plan.last  # As a phase before has failed or not.
        has_failed = outcome != "success" or (leaves and segment.change.failed)
        ends = self.task.plan.ends_in_contact(place) if outcome == "success" else None
        cause = PhaseCause(reason, after.chosen, has_failed, ends)
        return self._plan.following(now, segment, moment, after.place, cause), status

    # What is shown.

    def _calc_reference(self, which: int, context: Context, output: BasicVector) -> None:
        segment = self._segment(context)
        if segment.change.in_contact == bool(which):
            output.SetFromVector(segment.reference(context.get_time()))
        else:
            output.SetFromVector(np.zeros(output.size()))

    def _calc_desired(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.desired(self._segment(context), context.get_time()))

    def _calc_phase(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([float(self._segment(context).change.place)])

    def _calc_in_contact(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([float(self._segment(context).change.in_contact)])

    def _calc_tared(self, context: Context, output: BasicVector) -> None:
        force = self._force_port.Eval(context).copy()
        force[self._force] -= self._seen(context)[1]
        output.SetFromVector(force)

    def _holds(self, context: Context) -> bool:
        """Whether the input port `hold` says so."""
        port = self._hold_port
        return port.HasValue(context) and bool(port.Eval(context)[0])

    def _calc_free_hold(self, context: Context, output: BasicVector) -> None:
        is_held = self._segment(context).change.in_contact or self._holds(context)
        output.SetFromVector([float(is_held)])

    def _calc_contact_hold(self, context: Context, output: BasicVector) -> None:
        segments = self.progress(context).segments or (self._segment(context),)
        begin = segments[-1].change
        is_open = not begin.in_contact or self._seen(context)[0] < self.task.contact_force
        # The force of an impact is no error to be integrated.
        settles = (
            self._traced.touched(segments) and context.get_time() < begin.time + segments[-1].over
        )
        output.SetFromVector([float(is_open or settles or self._holds(context))])

    def traced(self) -> Block:
        period, updates = self._sample_period, tuple[Update, ...]()
        nothing = ca.Function("none", [], [ca.SX.zeros(1)])
        unwired = ["hold", *(port.get_name() for port in self.signal_ports.values())]
        if period:
            updates = (Update(self._traced.unchanged(), period, 0.0, True),)
        return Block(
            self,
            self._traced.computations(),
            updates,
            guard=Guard(self._traced.guard(), self._advance, bool(period)),
            unwired={name: Computation(nothing, (), (name,)) for name in unwired},
            ports={"phase": (Signal("phase"),)},
        )
