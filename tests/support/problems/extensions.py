"""Systems of the literature whose B(x) is singular, and their extensions."""

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem, Extension, Signal, dynamic_extension
from drake_dae.trace.functions import TracedFunction
from problems import PROBLEMS, changed

GRAVITY = 9.81


def unicycle(**changes) -> DaeSystem:
    """A wheel that rolls and turns: x' = v cos, y' = v sin, heading' = w (Isidori 1995, 5.4)."""
    fields = {
        "f": lambda x: [0, 0, 0],
        "h": lambda x: [[ca.cos(x[2]), 0], [ca.sin(x[2]), 0], [0, 1]],
        "l": lambda x: [x[0], x[1]],
        "control_signals": [Signal("v", "m/s"), Signal("w", "rad/s")],
        "name": "unicycle",
    }
    return DaeSystem.from_functions(["x", "y", "heading"], **{**fields, **changes})


def wheels() -> DaeSystem:
    """The same on two wheels of radius 0.5, 0.5 apart: v = (left + right)/4, w = right - left."""
    return unicycle(
        h=lambda x: [
            [0.25 * ca.cos(x[2]), 0.25 * ca.cos(x[2])],
            [0.25 * ca.sin(x[2]), 0.25 * ca.sin(x[2])],
            [-1, 1],
        ],
        control_signals=["left", "right"],
    )


def vtol() -> DaeSystem:
    """A planar aircraft without the coupling of roll to lift (Hauser, Sastry and Meyer 1992)."""
    return DaeSystem.from_functions(
        ["x", "y", "roll", "vx", "vy", "rate"],
        f=lambda x: [x[3], x[4], x[5], 0, -GRAVITY, 0],
        h=lambda x: [*[[0, 0]] * 3, [-ca.sin(x[2]), 0], [ca.cos(x[2]), 0], [0, 1]],
        l=lambda x: [x[0], x[1]],
        control_signals=[Signal("thrust", "m/s^2"), "torque"],
        name="vtol",
    )


CRANE = np.array([3.0, 0.5, 1.0])
"""Masses of the trolley, of the winch and of the load, in kg."""


def crane(**changes) -> DaeSystem:
    """A load on a rope from a winch on a trolley, z = load (Fliess et al. 1995: it is flat).

    k = ((X - s)^2 + Y^2 - l^2)/2 keeps the rope tight, v is its tension over its length.
    """
    fields = {
        "f": lambda x: [*ca.vertsplit(x[4:]), 0, 0, 0, -GRAVITY],
        "g": lambda x: [
            *[0] * 4,
            -(x[2] - x[0]) / CRANE[0],
            -x[1] / CRANE[1],
            (x[2] - x[0]) / CRANE[2],
            x[3] / CRANE[2],
        ],
        "h": lambda x: [*[[0, 0]] * 4, [1 / CRANE[0], 0], [0, 1 / CRANE[1]], [0, 0], [0, 0]],
        "k": lambda x: ((x[2] - x[0]) ** 2 + x[3] ** 2 - x[1] ** 2) / 2,
        "l": lambda x: [x[2], x[3]],
        "m": lambda x: [0, 0],
        "control_signals": [Signal("trolley", "N"), Signal("winch", "N")],
        "output_signals": ["X", "Y"],
        "nominal_state": [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0],
        "name": "crane",
    }
    names = ["s", "l", "X", "Y", "s'", "l'", "X'", "Y'"]
    return DaeSystem.from_functions(names, **{**fields, **changes})


def sleigh() -> DaeSystem:
    """The knife edge of the problems, steered by where it is."""
    system = PROBLEMS["knife_edge"]().system
    return changed(system, l=system.state[:2], output_signals=("x", "y"))


def evaluated(system: DaeSystem, state, **expressions: ca.SX) -> list[np.ndarray]:
    """As matrices."""
    function = TracedFunction(
        "values", {"x": system.state, "p": system.parameter_symbol}, expressions
    )
    found = function(state, system.parameter_values)
    return [
        value.reshape(e.shape) if value.ndim == 1 else value
        for value, e in zip(found, expressions.values(), strict=True)
    ]


REGULAR = {
    "unicycle": (unicycle, {"v": 0.8}, {"v": 1}, (2, 2)),
    "wheels": (wheels, {"left": 1.0, "right": 2.0}, {"left": 1}, (2, 2)),
    "vtol": (vtol, {"thrust": GRAVITY}, {"thrust": 2}, (4, 4)),
    "crane": (crane, {"winch": -GRAVITY}, {"winch": 2}, (4, 4)),
    "sleigh": (sleigh, {}, {"u0": 1}, (3, 3)),
}


def extension_of(name: str) -> Extension:
    make, nominal, _, _ = REGULAR[name]
    return dynamic_extension(make(), nominal_control=nominal)
