"""The state of the links of a robot with springs in its joints, and the torques on them."""

from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.formulas import Formula, TracedFormula
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, port_value
from drake_dae.systems.blocks.traced import PARAMETERS, Block, Computation
from drake_dae.trace.functions import TracedFunction


class SpringView(ParameterizedSystem):
    """State of the links and torque of the springs, from the state of a robot with springs:

        tau = K (q_2 - q) + D (q_2' - q').

    Input port:
        estimated_state: x = (q, v, s), shape (n,).

    Output ports:
        link_state: (q, v), shape (nq + nv,).
        joint_torque: tau in N m (N), shape (p,).

    Numeric parameter 0 holds the parameters of the robot's model.

    Args:
        model: A robot with stages of actuation.

    Raises:
        ModelError: The joints are rigid.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, model: RobotModel) -> None:
        dae = model.dae
        if model.joint_force is None:
            raise ModelError(f"{model.name} has rigid joints, and so no springs with a torque")
        super().__init__(dae, dae.parameter_values, {"state": dae.state_signals}, sees_steps=False)
        self.set_name("spring_view")
        size = model.links.q.numel() + model.links.v.numel()
        self._functions = {
            "link_state": dae.trace("state of the links", {"value": dae.state[:size]}),
            "joint_torque": dae.trace("torque of the springs", {"value": model.joint_force}),
        }
        self._port = self.DeclareVectorInputPort("estimated_state", dae.num_states)
        tickets = {self.input_port_ticket(self._port.get_index()), self.all_parameters_ticket()}
        for name, function in self._functions.items():
            value = port_value(self._value, function)
            self.DeclareVectorOutputPort(name, function.outputs[0].size, value, tickets)

    def _value(self, function: TracedFunction, context: Context) -> FloatArray:
        return self._checked(function, context, self._port.Eval(context))[0]

    def _formulas(self) -> dict[str, Formula]:
        return {
            name: TracedFormula(function, "value", ["estimated_state", "parameters"])
            for name, function in self._functions.items()
        }

    def traced(self) -> Block:
        return Block(
            self,
            tuple(
                Computation.of(function, ("estimated_state", PARAMETERS), (name,))
                for name, function in self._functions.items()
            ),
            signals=self._signals,
        )
