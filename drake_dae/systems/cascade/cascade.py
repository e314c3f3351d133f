"""A law of low degree for robots with springs in their joints: a cascade of two laws."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.beyond.spring_bound import spring_error_bound
from drake_dae.dae.beyond.spring_loop import SpringLoop
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.gains import FeedbackGains, GainDesign
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.errors import ModelError, WiringError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.systems.cascade.spring_view import SpringView
from drake_dae.systems.cascade.torque_loop import TorqueLoop, stages_of
from drake_dae.systems.control.contract import Controller, Derived
from drake_dae.systems.control.controller import TrackingController
from drake_dae.systems.plants.contract import Plant

_SAMPLES = 501
"""The number of times along a reference at which its torques are examined."""


@checked(ModelError)
class SpringCascade(Diagram, Controller):
    """A cascade for a robot with springs in its joints: the rigid law, and a loop on the torques.

    The law (28) of the links alone, `link_side(model)`, computes the torque tau_d that they need,
    and a `TorqueLoop` controls the springs to this torque. So only the derivatives of the rigid law
    are needed, whereas the law (28) of the whole robot takes four, and needs smooth friction, an
    exact model and little noise. In exchange the errors do not follow (30) exactly: by singular
    perturbation, the springs add errors of the order of the squared ratio of the rates of motion
    and loop, bounded by `spring_error_bound`. A `DisturbanceObserver` of the rigid law takes the
    torque of the springs as its control, so that it observes disturbances of the links without the
    loop in between.

    Input ports:
        estimated_state: x = (q, v, s) of the whole robot, shape (n,).
        reference, measured_force, exogenous, hold: As for the `TrackingController` of the law.
        acting_control: The control that acts on the plant, shape (p,).

    Output ports:
        control: u of the motors, or their voltages, shape (p,).
        tracking_error, integral: As of a `TrackingController`.
        link_state, joint_torque: As of a `SpringView`; state and control of an observer.
        wanted_torque: tau_d in N m (N), shape (p,).
        motor_disturbance: As of a `TorqueLoop`.

    Args:
        law: The law of `link_side(model)`, also `with_disturbance`.
        model: The robot with springs.
        loop: The rates of the loop.
        sample_period: T in s, positive; also of integrals.
        control_lag: As of the `TorqueLoop`.
        delay: The delay of the control in s, for `error_bound`.

    Attributes:
        law, model, delay: The arguments.
        view, controller, torque_loop: The blocks in it.

    Raises:
        ModelError: Law and robot do not fit, or the actuation is not supported.
    """

    __slots__ = SHARED_DICTIONARY
    shown = ("tracking_error",)

    def __init__(
        self,
        law: TrackingLaw,
        model: RobotModel,
        loop: SpringLoop,
        sample_period: float,
        control_lag: float = 0.0,
        delay: float = 0.0,
    ) -> None:
        super().__init__()
        self.law, self.model, self.sample_period = law, model, sample_period
        self.delay = delay
        size = model.links.q.numel() + model.links.v.numel()
        if law.system.num_states != size or law.system.num_controls != model.dae.num_controls:
            raise ModelError(
                f"the law of a cascade is that of the links, with {size} states; make it for "
                f"link_side(model), got one with {law.system.num_states}"
            )
        builder = DiagramBuilder()
        self.view = builder.AddSystem(SpringView(model))
        self.controller = builder.AddSystem(TrackingController(law, sample_period=sample_period))
        self.torque_loop = builder.AddSystem(
            TorqueLoop(model, law, loop, sample_period, control_lag)
        )
        view, controller, inner = self.view, self.controller, self.torque_loop
        self.exogenous_layout = controller.exogenous_layout
        self.exogenous_places = controller.exogenous_places

        # The links' state goes to the rigid law, and its torque to the loop.
        builder.ExportInput(view.GetInputPort("estimated_state"), "estimated_state")
        builder.ConnectInput("estimated_state", inner.GetInputPort("estimated_state"))
        builder.Connect(
            view.GetOutputPort("link_state"), controller.GetInputPort("estimated_state")
        )
        builder.Connect(controller.GetOutputPort("control"), inner.GetInputPort("wanted_torque"))
        for name in ("reference", "measured_force", "exogenous", "hold"):
            if controller.HasInputPort(name):
                builder.ExportInput(controller.GetInputPort(name), name)
        if inner.HasInputPort("exogenous"):
            builder.ConnectInput("exogenous", inner.GetInputPort("exogenous"))
        builder.ExportInput(inner.GetInputPort("control"), "acting_control")

        builder.ExportOutput(inner.GetOutputPort("control"), "control")
        builder.ExportOutput(controller.GetOutputPort("tracking_error"), "tracking_error")
        if law.integral.outputs:
            builder.ExportOutput(controller.GetOutputPort("integral"), "integral")
        builder.ExportOutput(controller.GetOutputPort("control"), "wanted_torque")
        for name in ("link_state", "joint_torque"):
            builder.ExportOutput(view.GetOutputPort(name), name)
        builder.ExportOutput(inner.GetOutputPort("motor_disturbance"), "motor_disturbance")
        builder.BuildInto(self)
        self.set_name("spring_cascade")

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        torques = tuple(self.model.links.actuator_signals)
        return {
            **self.controller.further_signals,
            "joint_torque": torques,
            "wanted_torque": torques,
            "motor_disturbance": self.torque_loop.disturbance_signals,
        }

    @property
    def observed(self) -> tuple[str, str]:
        return "link_state", "joint_torque"

    def all_parameters(self, context: Context) -> FloatArray:
        return self.controller.all_parameters(self.GetSubsystemContext(self.controller, context))

    def current_parameters(self, context: Context) -> FloatArray:
        return self.controller.current_parameters(
            self.GetSubsystemContext(self.controller, context)
        )

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        self.controller.set_gains(self.GetMutableSubsystemContext(self.controller, context), gains)

    def check_plant(self, plant: Plant) -> None:
        sizes = [(dae.num_states, dae.num_controls) for dae in (self.model.dae, plant.dae)]
        if sizes[0] != sizes[1]:
            needs, has = ("{} states, {} controls".format(*size) for size in sizes)
            raise WiringError(
                f"the cascade is for '{self.model.dae.name}' with {needs}, the plant "
                f"'{plant.dae.name}' has {has}. Make it with the plant's model"
            )

    def derived(
        self, context: Context | None, times: FloatArray, values: Mapping[str, FloatArray]
    ) -> Derived:
        return self.controller.derived(None, times, values)

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """The predicted error of the rigid law, for springs that have the desired torque."""
        states = np.asarray(values["state"])[:, : self.law.system.num_states]
        return self.controller.predicted_error(times, {**values, "state": states}, parameters)

    def error_bound(
        self, reference: Callable[[float], FloatArray], times: FloatArray, state: FloatArray
    ) -> FloatArray | None:
        """The `spring_error_bound` along the reference; None if no motion follows it."""
        law, links = self.law, self.law.system.num_states
        if times.size < 2 or not times[-1] > times[0]:
            return None
        grid = np.linspace(times[0], times[-1], _SAMPLES)
        motion = ZeroDynamics(law.system, structure=law.structure).motion(
            reference, grid, np.asarray(state)[:links]
        )
        if motion.ending is not None:
            return None
        spring = stages_of(self.model)[0]
        dae, p = self.model.dae, self.model.dae.num_controls
        function = dae.trace("springs", {"K": spring.stiffness, "B": spring.inertia}, often=False)
        matrices = function(dae.nominal_state, dae.parameter_values)
        stiffness, inertia = (np.array(matrix).reshape(p, p) for matrix in matrices)
        return spring_error_bound(
            law,
            grid,
            motion.states,
            motion.controls,
            stiffness,
            inertia,
            self.torque_loop.loop,
            self.sample_period,
            self.delay,
        )
