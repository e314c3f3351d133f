"""The computations of a `ContactPlant` around the part that Drake steps."""

from collections.abc import Callable

import casadi as ca
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import HELD, Computation, Computations, DrakeStepped
from drake_dae.robots import contact_normals
from drake_dae.systems.plants.contact.contact_forces import ContactForces
from drake_dae.systems.plants.contract import Plant


def traced_contact(
    plant: Plant,
    contact: ContactForces,
    held_in: Callable[[Context], FloatArray],
    put: Callable[[Context, FloatArray], None],
    values: FloatArray,
) -> Computations:
    """The computations of a `ContactPlant`, whose HELD is (q, v) and the contact forces.

    Args:
        plant: The `ContactPlant`, which Drake steps.
        contact: The block of the contact forces in it.
        held_in, put: As `DrakeStepped.held` and `put`.
        values: Values of all its parameters.
    """
    dae, manifold, forces = plant.dae, plant.structure.manifold, contact.contact_force_signals
    positions, results = map(plant.GetOutputPort, ("state", "contact_results"))

    count = positions.size()

    def read(context: Context, into: FloatArray) -> None:
        into[:count] = positions.Eval(context)
        # Half the time of evaluating the port of the contact force.
        into[count:] = contact.contact_force(results.Eval(context))

    stepped = DrakeStepped(
        plant,
        plant.time_step,
        ("state", "contact_force"),
        "control",
        held_in,
        put,
        read,
        count + len(forces),
    )
    held, parameters = ca.SX.sym("held", stepped.size), ca.DM(values)
    state, contact_force = ca.vertsplit(held, [0, count, stepped.size])
    normals = contact_normals(plant.robot("contact")).function(state, parameters)[0]
    force = ca.sum1(ca.reshape(normals * contact_force, 3, -1)).T
    acting = ca.SX.sym("force", force.numel())
    expressions = [dae.outputs(acting), manifold.residual_expression]
    symbols = [dae.state, dae.parameter_symbol, acting]
    output, residual = ca.substitute(expressions, symbols, [state, parameters, force])
    shown = {
        "state": state,
        "link_state": state,
        "contact_force": contact_force,
        "constraint_force": force,
        "constraint_residual": residual,
        "controlled_output": output,
    }
    computations = tuple(
        Computation(ca.Function(name, [held], [value]), (HELD,), (name,))
        for name, value in shown.items()
    )
    ports = {**plant.port_signals, "contact_force": forces}
    return Computations(plant, computations, stepped=stepped, ports=ports)
