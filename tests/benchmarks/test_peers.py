"""The dynamics of a constrained arm beside Pinocchio and MuJoCo, as the referee describes them.

Accelerations are compared first: with Pinocchio's to 1e-9, with MuJoCo's to 2e-3, since its
constraints are soft and 0.9999 is the hardest that it takes. All are called from Python; less what
a call takes there is what a program in C++ would see. Ours in C is a loop over 200 states in
generated code. `mj_forward` also does what a robot without contact and sensors has little of. Of a
peer that is not installed a line says so.
"""

from importlib import import_module

import numpy as np
from numpy.testing import assert_allclose
from referee.description import Body, Closure, Mechanism, Y, Z
from referee.engines.ours import model_of
from referee.tree import controls
from timing import calls, times

from drake_dae import DaePlant
from drake_dae.systems.ideal_plants import dae_block
from drake_dae.trace.functions import TracedFunction

LENGTHS, MASSES = (0.3, 0.3, 0.3, 0.3, 0.2, 0.2, 0.1), (4.0, 4.0, 3.0, 2.7, 1.7, 1.6, 0.4)


def link(i: int) -> Body:
    """One of seven links in a row, none of them symmetric, that turn about z and y."""
    return Body(
        f"link{i}",
        (("turn", (Z, Y)[i % 2]),),
        f"link{i - 1}" if i else "world",
        (0.01, -0.02, LENGTHS[i - 1]) if i else (0.0, 0.0, 0.1),
        MASSES[i],
        (0.02, -0.01, LENGTHS[i] / 2),
        (0.01 * MASSES[i], 0.012 * MASSES[i], 0.004 * MASSES[i]),
    )


ARM = Mechanism(
    "one",
    tuple(map(link, range(7))),
    (Closure("pin", "point", "world", (0.6, 0.0, 0.6), "link6", (0.0, 0.0, LENGTHS[-1])),),
    q=(0.1, 0.2, -0.1, 1.6, 0.2, 0.6, 0.1),
    free=(),
    torques=dict.fromkeys(range(7), 1.0),
)


def pinocchio_calls(mechanism, q, v, wanted):
    """`constraintDynamics`, and the same of a joint alone: what a call from Python takes."""
    engine, once = import_module("referee.engines.pinocchio_engine"), (1e-12, 0.0, 1)
    whole, _, places = engine.solver(mechanism, q, v, once)
    assert_allclose(whole()[places], wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    lone = Mechanism("lone", (Body("lone"),), (), (0.0,), (0,))
    return whole, engine.solver(lone, np.zeros(1), np.zeros(1), once)[0]


def mujoco_calls(mechanism, q, v, wanted):
    """`mj_forward` with MuJoCo's own settings, and a call that does next to nothing."""
    mujoco = import_module("mujoco")
    model, data = import_module("referee.engines.mujoco_engine").solved(mechanism, q, v, {})
    options, switch = model.opt, mujoco.mjtDisableBit
    options.tolerance, options.iterations = 1e-8, 100
    options.ls_tolerance, options.ls_iterations = 0.01, 50
    options.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    options.disableflags |= switch.mjDSBL_CONTACT | switch.mjDSBL_LIMIT | switch.mjDSBL_ISLAND
    mujoco.mj_forward(model, data)
    assert_allclose(data.qacc, wanted, atol=2e-3 * np.abs(wanted).max())
    return lambda: mujoco.mj_forward(model, data), lambda: mujoco.mj_isSparse(model)


PEERS = {"Pinocchio": pinocchio_calls, "MuJoCo": mujoco_calls}


def test_dynamics(compare):
    mechanism, name = ARM, "7 joints, tool on a point"
    plant, random = DaePlant(model_of(mechanism).dae), np.random.default_rng(0)
    block = dae_block(plant.structure)
    inputs = {"x": block.state, "u": block.inputs["control"], "p": block.parameters}
    dynamics = [
        TracedFunction("dynamics", inputs, {"rate": block.derivative}, compiled=compiled)
        for compiled in (False, True)
    ]
    nominal = plant.dae.nominal_state
    state = plant.structure.manifold.project(nominal + 0.1 * random.normal(size=nominal.size))
    q, v = np.split(state, 2)
    given = state, np.array(controls(mechanism)), plant.dae.parameter_values
    wanted = dynamics[0](*given)[0][q.size :]
    functions = calls(dynamics, *given)
    ours = list(functions)
    for peer, make in PEERS.items():
        try:
            both = make(mechanism, q, v, wanted)
        except ImportError:
            compare(f"dynamics, {name}", 0.0, f"{peer} is missing, see [benchmark]")
        else:
            functions |= dict(zip((peer, f"{peer}, nothing"), both, strict=True))
    took = times(functions)
    for peer in (peer for peer in PEERS if peer in took):
        for how in ours:
            # What a loop in C computes stands beside what a call takes less its way from Python.
            in_c = how == "in C"
            other = took[peer] - took[f"{peer}, nothing"] * in_c
            label = f"{peer} less its call" if in_c else f"{peer} from Python"
            wanted_ratio = "" if how == "interpreted" else 1.0
            compare(f"dynamics, {name}: {how}", took[how], label, other, wanted_ratio)
