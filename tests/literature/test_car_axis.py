"""The car axis of the Test Set for IVP Solvers, against its published solution, as a DaeSystem.

S. Schneider, 1994; F. Mazzia and C. Magherini, Test Set for Initial Value Problem Solvers, release
2.4, 2008, problem "Car axis", index 3; its equations, numbers and solution were read in the Fortran
source caraxis.f of the test set, as packaged in deTestSet for R. Two wheels on springs carry a
chassis of length L; the right wheel rolls over a bumpy road, so a constraint moves with time.
"""

import casadi as ca
import numpy as np
import pytest
from arms import error_controlled
from numpy.testing import assert_allclose
from pydrake.systems.framework import DiagramBuilder

from drake_dae import DaePlant, DaeSystem, ExpressionReference, ReferenceGenerator, simulate

MASS, LENGTH, SPRING, ROAD, TURN, GRAVITY = 10.0 * 0.01**2 / 2, 1.0, 0.5, 0.1, 10.0, 1.0

START = [0.0, 0.5, 1.0, 0.5, -0.5, 0.0, -0.5, 0.0]

# At 3 s, by an integrator in quadruple precision.
END = [
    *(0.493455784275402809122e-1, 0.496989460230171153861e0),
    *(0.104174252488542151681e1, 0.373911027265361256927e0),
    *(-0.770583684040972357970e-1, 0.744686658723778553466e-2),
    *(0.175568157537232222276e-1, 0.770341043779251976443e0),
]
END_FORCES = [-0.473688659084893324729e-2, -0.110468033125734368808e-2]


def wheel(time):
    """x and y of the right wheel."""
    height = ROAD * ca.sin(TURN * time)
    return ca.sqrt(LENGTH**2 - height**2), height


def rates(s, p):
    (xb, yb), (xl, yl, xr, yr, *v) = wheel(p.time), ca.vertsplit(s)
    left, right = ca.hypot(xl, yl), ca.hypot(xr - xb, yr - yb)
    pull_l, pull_r = (SPRING - left) / left / MASS, (SPRING - right) / right / MASS
    return [
        *v,
        *(pull_l * xl, pull_l * yl - GRAVITY),
        *(pull_r * (xr - xb), pull_r * (yr - yb) - GRAVITY),
    ]


def forces(s, p):
    (xb, yb), (x, y) = wheel(p.time), (s[0] - s[2], s[1] - s[3])
    acting = [[xb, 2 * x], [yb, 2 * y], [0.0, -2 * x], [0.0, -2 * y]]
    return [[0.0, 0.0]] * 4 + [[one / MASS, two / MASS] for one, two in acting]


def gaps(s, p):
    xb, yb = wheel(p.time)
    return [xb * s[0] + yb * s[1], (s[0] - s[2]) ** 2 + (s[1] - s[3]) ** 2 - LENGTH**2]


@pytest.mark.slow
def test_the_car_axis_ends_where_the_test_set_says():
    """Positions to ten digits after 3 s and five bumps, rates and forces to eight.

    1e-11 in a step leaves 1e-11 of positions; the springs' 45 rad/s make that 5e-10 of rates.
    """
    system = DaeSystem.from_functions(
        ["xl", "yl", "xr", "yr", "vxl", "vyl", "vxr", "vyr"],
        f=rates,
        g=forces,
        k=gaps,
        parameters={"time": 0.0},
        exogenous=["time"],
        nominal_state=START,
        name="car axis",
    )
    plant = DaePlant(system)
    assert plant.structure.constraint_degrees == (2, 2)
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    clock = ReferenceGenerator([ExpressionReference(lambda t: t)], plant.exogenous_layout.degrees)
    builder.AddSystem(clock)
    builder.Connect(clock.get_output_port(), plant.GetInputPort("exogenous"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.set_state(own, START)
    simulate(diagram, context, 3.0, error_controlled(1e-11))
    state = plant.state(own)
    assert_allclose(state[:4], END[:4], atol=1e-10)
    assert_allclose(state[4:], END[4:], atol=5e-9)
    found = plant.GetOutputPort("constraint_force").Eval(own)
    assert_allclose(found, END_FORCES, atol=1e-8 * np.abs(END_FORCES).max())
