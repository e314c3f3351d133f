"""The flexible slider crank of the Test Set for IVP Solvers, against its published solution.

B. Simeon, Modelling a flexible slider crank mechanism by a mixed system of DAEs and PDEs, Math.
Modelling of Systems 2, 1-18 (1996): a crank turned at 150 rad/s by a constraint in time, a
connecting rod with two lateral and two longitudinal shapes of deformation, a sliding block. Its
published form restricts velocities (index 2); its start meets the positions to the ten digits that
were printed, 2e-10 m off.
"""

import casadi as ca
import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

from drake_dae.dae import DaeSystem, Parameter, find_constraint_structure
from drake_dae.references import ExpressionReference
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.plants.dae_plant import DaePlant

M2, M3, L1, L2, J1, J2 = 0.151104, 0.075552, 0.15, 0.30, 0.002727, 0.0045339259
ELASTIC, WIDTH, DENSITY, SPEED, PI = 0.2e12, 0.008, 7870.0, 150.0, 3.1415927

START = np.array(
    [
        *(0.0, 0.0, 0.450016933, 0.0, 0.0, 0.103339863e-4, 0.169327969e-4),
        *(150.0, -74.9957670, -0.268938672e-5),
        *(0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5),
    ]
)

# Its reference at 0.1 s, by an integrator at 1e-14 or so, as the test set prints it.
END = np.array(
    [
        *(1.5e1, -3.311734987910881e-1, 1.697373326718410e-1),
        *(1.893192460247178e-4, 2.375751865617931e-5),
        *(-5.323907988763734e-6, -8.363283141616840e-6),
        *(1.5e2, 6.025346682645789e1, -8.753116989887888),
        *(-3.005536801092212e-2, -5.500488291932075e-3),
        *(4.978243404809343e-4, 1.104933470696396e-3),
    ]
)
FORCES = np.array([-6.232893262533717e1, -1.637910131687472e2, 2.529853213732781e1])


def crank(level: int) -> DaeSystem:
    """The mechanism with its constraints on positions (0) or on velocities (1)."""
    p, v = ca.SX.sym("p", 7), ca.SX.sym("v", 7)
    time = Parameter("time", 0.0, exogenous=True)
    q, qd = p[3:], v[3:]
    area, volume = WIDTH**2, WIDTH**2 * L2
    mass, stiffness = DENSITY * volume, ELASTIC * area / L2
    M = mass * ca.DM([[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 8, 1], [0, 0, 1, 2]])
    K = stiffness * ca.DM(
        [
            [PI**4 / 24 * (WIDTH / L2) ** 2, 0, 0, 0],
            [0, PI**4 * 2 / 3 * (WIDTH / L2) ** 2, 0, 0],
            [0, 0, 16 / 3, -8 / 3],
            [0, 0, -8 / 3, 7 / 3],
        ]
    )
    a, b = 16 / PI**3, 8 / PI**3 - 1 / PI
    B = volume * ca.DM([[0, 0, -a, b], [0, 0, 0, 0.5 / PI], [a, 0, 0, 0], [-b, -0.5 / PI, 0, 0]])
    c1, c2 = volume * ca.DM([0, 0, 2 / 3, 1 / 6]), volume * ca.DM([2 / PI, 0, 0, 0])
    c12 = L2 * volume * ca.DM([0, 0, 1 / 3, 1 / 6])
    c21 = L2 * volume * ca.DM([1 / PI, -0.5 / PI, 0, 0])
    sine, cosine = ca.sin(p[0] - p[1]), ca.cos(p[0] - p[1])

    inertia = ca.SX(7, 7)
    inertia[0, 0], inertia[2, 2] = J1 + M2 * L1**2, M3
    inertia[0, 1] = 0.5 * L1 * L2 * M2 * cosine
    inertia[0, 1] += DENSITY * L1 * (sine * ca.dot(c2, q) + cosine * ca.dot(c1, q))
    inertia[1, 1] = J2 + ca.bilin(M, q, q) + 2 * DENSITY * ca.dot(c12, q)
    inertia[0, 3:] = (DENSITY * L1 * (-sine * c1 + cosine * c2)).T
    inertia[1, 3:] = (DENSITY * (c21 + ca.mtimes(B.T, q))).T
    inertia[3:, 3:] = M
    inertia = ca.triu2symm(ca.triu(inertia))

    one = -0.5 * L1 * L2 * M2 * v[1] ** 2 * sine
    one += DENSITY * L1 * v[1] ** 2 * (-sine * ca.dot(c1, q) + cosine * ca.dot(c2, q))
    one -= 2 * DENSITY * L1 * v[1] * (cosine * ca.dot(c1, qd) + sine * ca.dot(c2, qd))
    two = 0.5 * L1 * L2 * M2 * v[0] ** 2 * sine
    two += DENSITY * L1 * v[0] ** 2 * (sine * ca.dot(c1, q) - cosine * ca.dot(c2, q))
    two -= 2 * v[1] * (DENSITY * ca.dot(c12, qd) + ca.bilin(M, qd, q))
    two -= DENSITY * ca.bilin(B, qd, qd)
    shapes = v[1] ** 2 * (ca.mtimes(M, q) + DENSITY * c12) - ca.mtimes(K, q)
    shapes += DENSITY * L1 * v[0] ** 2 * (cosine * c1 + sine * c2)
    shapes += 2 * DENSITY * v[1] * ca.mtimes(B, qd)

    rod = L2 + q[3]
    positions = ca.vertcat(
        L1 * ca.sin(p[0]) + rod * ca.sin(p[1]),
        p[2] - L1 * ca.cos(p[0]) - rod * ca.cos(p[1]),
        p[0] - SPEED * time.symbol,
    )
    jacobian = ca.jacobian(positions, p)
    velocities = ca.mtimes(jacobian, v) - ca.vertcat(0, 0, SPEED)
    return DaeSystem(
        state=ca.vertcat(p, v),
        mass_matrix=ca.diagcat(ca.SX.eye(7), inertia),
        f=ca.vertcat(v, one, two, 0, shapes),
        g=ca.vertcat(ca.SX(7, 3), -jacobian.T),
        h=ca.SX(14, 0),
        k=positions if level == 0 else velocities,
        l=ca.SX(0, 1),
        m=ca.SX(0, 3),
        parameters=(time,),
        nominal_state=START,
        state_scale=np.where(START == 0.0, 1e-5, np.abs(START)),
        name="flexible slider crank",
    )


def run(level: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State and constraint forces at 0.1 s, and how far each state of the start was moved."""
    system = crank(level)
    builder = DiagramBuilder()
    plant = builder.AddSystem(DaePlant(system, structure=find_constraint_structure(system)))
    clock = ReferenceGenerator([ExpressionReference(lambda t: t)], plant.exogenous_layout.degrees)
    builder.AddSystem(clock)
    builder.Connect(clock.get_output_port(), plant.GetInputPort("exogenous"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    started = plant.set_consistent_state(own, START)
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-5, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.AdvanceTo(0.1)
    simulator.AdvancePendingEvents()
    forces = plant.GetOutputPort("constraint_force").Eval(own)
    return plant.state(own), forces, np.abs(started - START)


@pytest.mark.slow
@pytest.mark.parametrize("level", [0, 1])
def test_the_published_solution(level):
    """Ten digits of positions and six of forces, as many as the printed start determines.

    Half the step changes the positions by 2e-11. Where positions are restricted, they move by the
    2e-10 m that the printed digits leave, and not by what velocities lack: the block by most of it,
    the rod that is heavier by a fifth, since that takes the least kinetic energy. Where velocities
    are restricted no position moves, and forces have the 2e-10 m that positions are off.
    """
    state, forces, moved = run(level)
    if level == 0:
        # Two parts of one correction, as their masses: M_3, and 15/8 of the rod's modal mass.
        rod = 15 / 8 * DENSITY * WIDTH**2 * L2
        assert moved[6] / moved[2] == pytest.approx(M3 / rod, rel=1e-3)
        assert moved[2] + moved[6] == pytest.approx(0.450016933 - L1 - L2 - START[6], rel=1e-3)
    else:
        assert not moved[:7].any()
    # The rotation of the rod is printed with nine digits.
    assert np.max(moved[7:]) < 4e-8
    np.testing.assert_allclose(state[9:], END[9:], rtol=0, atol=(2e-7, 1e-6)[level])
    np.testing.assert_allclose(state[:7], END[:7], rtol=0, atol=2e-10)
    np.testing.assert_allclose(forces, FORCES, rtol=(5e-6, 1e-5)[level])


def digits(state: np.ndarray) -> float:
    """How many digits of every position agree with the reference, each by its own size."""
    return float(-np.log10(np.max(np.abs(state[:7] / END[:7] - 1.0))))


@pytest.mark.slow
@pytest.mark.thorough
def test_the_projection_of_the_start_costs_no_digit():
    """The printed start, not moved at all, leads to fewer digits than its projection.

    Accelerations alone are restricted here, by an integrator of SciPy: 5.4 digits beside 5.9. More
    are not in the printed start. To come nearer than 6.8 of them the deformations must begin where
    no projection leads that moves a state by what a constraint lacks: fitted to the published end,
    8e-11 m beside the lateral shapes, which no constraint force moves there, and 1.6e-7 m/s beside
    a velocity, where 4e-8 is missing. That fit, by differences of runs, is not repeated here.
    """
    system = crank(0)
    p, v = system.state[:7], system.state[7:]
    gradient = ca.jacobian(system.k, p)
    mass, forces = system.mass_matrix[7:, 7:], system.f[7:]
    rates = ca.jtimes(gradient @ v, p, v)  # The third constraint is linear in time.
    matrix = ca.blockcat([[mass, gradient.T], [gradient, ca.SX(3, 3)]])
    acceleration = ca.solve(matrix, ca.vertcat(forces, -rates))[:7]
    rate = ca.Function("rate", [system.state], [ca.vertcat(v, acceleration)])
    raw = solve_ivp(
        lambda _, x: rate(x).full().ravel(),
        (0.0, 0.1),
        START,
        method="DOP853",
        rtol=1e-12,
        atol=1e-17,
        max_step=2e-5,
    )
    assert digits(raw.y[:, -1]) == pytest.approx(5.4, abs=0.1)
    assert digits(run(0)[0]) > 5.7
