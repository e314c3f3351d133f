"""The speeds of a robot's contact points along a motion."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True)
class ContactSpeed:
    """The largest speed of a contact point along a motion.

    Attributes:
        constraint: The name of its constraint.
        frame: The frame of the point.
        speed: |p_W'|, in the world, in m/s.
        time: The time of that speed, in s.
    """

    constraint: str
    frame: str
    speed: float
    time: float

    def __str__(self) -> str:
        where = "" if self.frame == self.constraint else f" at '{self.constraint}'"
        return f"{self.frame}{where} goes at {self.speed:.3g} m/s at most, at {self.time:.4g} s"


def contact_speeds(
    model: RobotModel, times: FloatArray, states: FloatArray, parameters: FloatArray
) -> tuple[ContactSpeed, ...]:
    """The largest speed of the contact point of each constraint that has a free side.

    Args:
        model: The robot.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
        parameters: The values of all parameters at these times, shape (k, P).
    """
    links, largest = model.links, list[ContactSpeed]()
    nq, nv = links.q.numel(), links.v.numel()
    kinematics = links.kinematics()
    inputs = {"q": links.q, "v": links.v, "parameters": model.dae.parameter_symbol}
    for constraint in model.constraints if len(times) else ():
        touch = constraint.touch(links)
        if touch is None:
            continue
        velocity = kinematics.value(kinematics.velocity(touch.frame, touch.point))
        function = TracedFunction("contact speed", inputs, {"speed": ca.norm_2(velocity)})
        speeds = np.array(
            [
                function(x[:nq], x[nq : nq + nv], numbers)[0].item()
                for x, numbers in zip(states, parameters, strict=True)
            ]
        )
        fastest = int(np.argmax(speeds))
        name, speed = constraint.name, float(speeds[fastest])
        largest.append(ContactSpeed(name, touch.frame, speed, float(times[fastest])))
    return tuple(largest)
