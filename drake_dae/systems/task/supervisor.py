"""The block that runs the phases of a task: their guards, their order and their references."""

from functools import partial

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import Block, Guard, Update, zero
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.dae.beyond.disturbance import DISTURBANCE
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.systems.control.contract import SIGNAL
from drake_dae.systems.task.contacts.open_contact import FREE, LAWS, ContactLaws
from drake_dae.systems.task.contacts.outputs import TaskOutputs
from drake_dae.systems.task.decision import PhaseDecision, moment_of
from drake_dae.systems.task.phases import Moment
from drake_dae.systems.task.phases.phase import FAIL, LEAVE, STOP
from drake_dae.systems.task.planner import ModelMoment, PhaseCause, TaskPlanner
from drake_dae.systems.task.progress import ReferenceSegment, TaskProgress
from drake_dae.systems.task.task import Task
from drake_dae.systems.task.traced import NAMES
from drake_dae.systems.task.transition import SampledTask


class TaskSupervisor(LeafSystem):
    """Runs the phases of a task one after the other; see `TaskController`.

    Input ports:
        estimated_state, measured_force, hold, signal_<name>: As of `TaskController`.
        control: u, shape (p,); only if a phase watches one.
        exogenous: As of the laws; only for exogenous signals that are not an observer's. Without
            a wire these keep the values of the parameters.

    Output ports:
        phase, desired_output, tared_force: As of `TaskController`.
        contact_reference, free_reference: R of the active law; zero for the other one.
        law: The number of the active law, shape (1,): 0 without contact, 1 in contact.
        ending: 0 while the task goes on; then 1 if it is done, 2 if it has stopped, 3 if the robot
            rests by "hold", shape (1,). In exports, which have no errors, 4 after "fail".
        contact_hold, free_hold: While it is 1, the law's integrals are not updated, shape (1,):
            while the other law is active, while no force is measured at one of the points, just
            after a touch, and while `hold` is not 0.

    Args:
        task: The phases.
        pair: The laws of the robot with and without its contact.
        columns: The places of their outputs in a record.
        num_forces: The number of all measured forces.
        sample_period: The period at which guards are evaluated, in s.

    Attributes:
        signal_ports: Name of a signal -> its input port.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        task: Task,
        pair: ContactLaws,
        columns: TaskOutputs,
        num_forces: int,
        sample_period: float,
    ) -> None:
        super().__init__()
        self.set_name("task")
        self._sample_period = sample_period
        self.task, self._columns = task, columns
        self._laws, self._contact = pair.laws, pair.contact
        laws = self._laws
        self._phases, self._plan = task.plan.phases, TaskPlanner(task, pair)
        self._traced = SampledTask(task, pair, columns, self._plan, num_forces, sample_period)
        system = laws[FREE].system
        self._state_port = self.DeclareVectorInputPort("estimated_state", system.num_states)
        self._force_port = self.DeclareVectorInputPort("measured_force", num_forces)
        self._hold_port = self.DeclareVectorInputPort("hold", 1)
        declared, self._control_port = self.DeclareVectorInputPort, None
        if task.controls:
            self._control_port = declared("control", system.num_controls)
        self._moving: list[int] = []
        moving = [parameter.name for parameter in system.exogenous.moving]
        if moving and DISTURBANCE not in moving:
            self._moving = system.exogenous.places(laws[FREE].exogenous_degrees)
            declared("exogenous", len(self._moving))
        self.signal_ports = {name: declared(SIGNAL + name, 1) for name in task.signals}
        self.DeclareNumericParameter(BasicVector(system.parameter_values))
        self._index = self.DeclareAbstractState(AbstractValue.Make(TaskProgress()))
        self._held = self.DeclareDiscreteState(self._traced.size)
        self.DeclareInitializationUnrestrictedUpdateEvent(weakly(self._begin))
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._advance))
        self._declare_outputs()

    def _declare_outputs(self) -> None:
        # Before a run, the outputs are those of the first phase if it began at the current state.
        by_state = {
            self.abstract_state_ticket(self._index),
            self.input_port_ticket(self._state_port.get_index()),
            self.all_parameters_ticket(),
        }
        if self._moving:
            by_state.add(self.input_port_ticket(self.GetInputPort("exogenous").get_index()))
        by_time = by_state | {self.time_ticket()}
        filtered = {
            self.input_port_ticket(self._force_port.get_index()),
            self.discrete_state_ticket(self._held),
        }
        for which, law in enumerate(self._laws):
            size, name = law.layout.reference_size, f"{LAWS[which]}_reference"
            self.DeclareVectorOutputPort(name, size, weakly(self._calc_reference, which), by_time)
        size = self._columns.size
        self.DeclareVectorOutputPort("desired_output", size, weakly(self._calc_desired), by_time)
        progress = {self.abstract_state_ticket(self._index), self.discrete_state_ticket(self._held)}
        for name, number in (("phase", "place"), ("law", "law"), ("ending", "ending")):
            self.DeclareVectorOutputPort(name, 1, weakly(self._calc_number, number), progress)
        hold = self.input_port_ticket(self._hold_port.get_index())
        for name, calc, tickets in (
            ("free_hold", weakly(self._calc_free_hold), by_state),
            ("contact_hold", weakly(self._calc_contact_hold), by_time | filtered),
        ):
            self.DeclareVectorOutputPort(name, 1, calc, tickets | {hold})
        if self.task.tare_time:
            size = self._force_port.size()
            self.DeclareVectorOutputPort("tared_force", size, weakly(self._calc_tared), filtered)

    def progress(self, context: Context) -> TaskProgress:
        """The progress of the task in a context of this system."""
        progress: TaskProgress = context.get_abstract_state(self._index).get_value()
        return progress

    def _now(self, context: Context) -> ModelMoment:
        parameters = context.get_numeric_parameter(0).CopyToVector()
        if self._moving and self.GetInputPort("exogenous").HasValue(context):
            parameters[self._moving] = self.GetInputPort("exogenous").Eval(context)
        return ModelMoment(context.get_time(), self._state_port.Eval(context), parameters)

    def _segment(self, context: Context) -> ReferenceSegment:
        """The current references."""
        progress = self.progress(context)
        return progress.segments[-1] if progress.segments else self._plan.first(self._now(context))

    # The end of a phase.

    def _moment(self, context: Context, segment: ReferenceSegment) -> Moment:
        controls = dict[str, float]()
        if self._control_port is not None:
            sizes = np.abs(self._control_port.Eval(context))
            controls = {name: float(sizes[i]) for name, i in self._plan.control_places.items()}
            controls[""] = float(sizes.max())
        signals = {
            name: float(port.Eval(context)[0]) if port.HasValue(context) else 0.0
            for name, port in self.signal_ports.items()
        }
        forces, time = self._traced.filter.forces(self._filtered(context)), context.get_time()
        motion = self._plan.motion(self._now(context))
        return moment_of(segment, self._contact, time, motion, forces, signals, controls)

    def _filtered(self, context: Context) -> FloatArray:
        """The state of the force filter after the present sample; see `TracedTask`."""
        held = context.get_discrete_state(self._held).value()
        return self._traced.filtered(held, self._force_port.Eval(context))

    def _decision(self, context: Context, progress: TaskProgress) -> PhaseDecision:
        moment = self._moment(context, progress.segments[-1])
        held = context.get_discrete_state(self._held).value()
        return PhaseDecision.of(self._traced, progress, moment, context.get_time(), held)

    def _is_over(self, segment: ReferenceSegment) -> bool:
        return segment.change.place >= len(self._phases)

    def _begin(self, context: Context, state: State) -> EventStatus:
        if self.progress(context).segments:
            return EventStatus.DidNothing()  # A run that is continued.
        time = context.get_time()
        if context.get_discrete_state_vector().value().any():
            raise SimulationError(
                f"{self.get_name()}: a task begins when its run does: a start cannot be in the "
                "middle of a task",
                time,
                self._state_port.Eval(context).copy(),
            )
        progress = TaskProgress((self._segment(context),), time - self._sample_period, time)
        self._put(state, progress, np.zeros(self._traced.filter.size))
        return EventStatus.Succeeded()

    def _advance(self, context: Context, state: State) -> EventStatus:
        progress, time = self.progress(context), context.get_time()
        if time == progress.step:
            return EventStatus.DidNothing()  # A continued run begins with the last sample.
        force, decision = self._filtered(context), self._decision(context, progress)
        status, segments = EventStatus.Succeeded(), progress.segments
        if decision.ends:
            following, status = self._changed(context, progress, decision)
            segments = (*segments, following)
        felt = time if progress.is_felt else progress.felt
        now = TaskProgress(segments, time, felt, progress.is_felt != decision.turns)
        self._put(state, now, force)
        return status

    def _put(self, state: State, progress: TaskProgress, force: FloatArray) -> None:
        state.get_mutable_abstract_state().get_mutable_value(int(self._index)).set_value(progress)
        state.get_mutable_discrete_state().set_value(self._traced.numbers(progress, force))

    def _changed(
        self, context: Context, progress: TaskProgress, decision: PhaseDecision
    ) -> tuple[ReferenceSegment, EventStatus]:
        """The references after a phase, and the status of the event."""
        segment, now, moment = progress.segments[-1], self._now(context), decision.moment
        if self._is_over(segment):
            cause = PhaseCause("the contact is lost at rest", segment.change.chosen, True)
            following = self._plan.following(now, segment, moment, None, cause)
            return following, EventStatus.Succeeded()
        place = segment.change.place
        outcome, reason = decision.outcome(self._phases[place], self.task.contact_force)
        entered = [change.place for change in progress.changes]
        chosen = [change.chosen for change in progress.changes]
        after = self.task.plan.successor(place, outcome, entered, chosen)
        reason = ", ".join(filter(None, (reason, after.remark)))
        if after.chosen == FAIL:
            raise decision.failure(reason, now.time, now.state)
        status = EventStatus.Succeeded()
        if after.place is None and after.chosen in (STOP, LEAVE):
            status = EventStatus.ReachedTermination(self, reason)
        leaves = place >= self.task.plan.last  # It has failed if the phase before has.
        has_failed = outcome != "success" or (leaves and segment.change.failed)
        ends = self.task.plan.ends_in_contact(place) if outcome == "success" else None
        cause = PhaseCause(reason, after.chosen, has_failed, ends)
        return self._plan.following(now, segment, moment, after.place, cause), status

    # The output ports.

    def _calc_reference(self, which: int, context: Context, output: BasicVector) -> None:
        segment = self._segment(context)
        if segment.law == which:
            output.SetFromVector(segment.reference(context.get_time()))
        else:
            output.SetFromVector(np.zeros(output.size()))

    def _calc_desired(self, context: Context, output: BasicVector) -> None:
        segment = self._segment(context)
        output.SetFromVector(segment.desired(self._columns, context.get_time()))

    def _calc_number(self, name: str, context: Context, output: BasicVector) -> None:
        value = context.get_discrete_state(self._held).value()[NAMES.index(name)]
        if not self.progress(context).segments:
            value = float(self.task.plan.contacts[0]) if name == "law" else 0.0
        output.SetFromVector([value])

    def _calc_tared(self, context: Context, output: BasicVector) -> None:
        force = self._force_port.Eval(context).copy()
        force[list(self._contact.forces)] -= self._traced.filter.bias(self._filtered(context))
        output.SetFromVector(force)

    def _holds(self, context: Context) -> bool:
        """Whether the input port `hold` is not 0."""
        port = self._hold_port
        return port.HasValue(context) and bool(port.Eval(context)[0])

    def _calc_free_hold(self, context: Context, output: BasicVector) -> None:
        is_held = self._segment(context).change.in_contact or self._holds(context)
        output.SetFromVector([float(is_held)])

    def _calc_contact_hold(self, context: Context, output: BasicVector) -> None:
        segments = self.progress(context).segments or (self._segment(context),)
        begin = segments[-1].change
        least = self._contact.size * min(self._traced.filter.forces(self._filtered(context)))
        is_open = not begin.in_contact or least < self.task.contact_force
        # The force of an impact is no error to be integrated.
        end = begin.time + segments[-1].over
        settles = self._traced.touched(segments) and context.get_time() < end
        output.SetFromVector([float(is_open or settles or self._holds(context))])

    def traced(self) -> Block:
        period, traced = self._sample_period, self._traced
        unwired = ["hold", *(port.get_name() for port in self.signal_ports.values())]
        return Block(
            self,
            traced.computations(),
            (Update(traced.unchanged(), period, 0.0, True),),
            guard=Guard(traced.guard(), self._advance, partial(traced.reaction, period)),
            unwired={name: zero(name) for name in unwired},
            moving=tuple(self._moving),
            ports={name: (Signal(name),) for name in ("phase", "ending")},
        )
