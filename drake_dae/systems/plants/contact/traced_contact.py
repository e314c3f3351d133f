"""The computations of a `ContactPlant` around the part that Drake steps."""

from collections.abc import Callable

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraint_wrenches import contact_normals
from drake_dae.systems.blocks.traced import HELD, Block, Computation, DrakeStepped, Update
from drake_dae.systems.plants.contact.contact_forces import ContactForces
from drake_dae.systems.plants.contact.stepped_stages import SteppedStages
from drake_dae.systems.plants.contract import Plant


def traced_contact(
    plant: Plant,
    scene: Diagram,
    contact: ContactForces,
    stages: SteppedStages | None,
    held_in: Callable[[Context], FloatArray],
    put: Callable[[Context, FloatArray], None],
    values: FloatArray,
) -> Block:
    """The computations of a `ContactPlant`, whose HELD is (q, v), contact forces, and the stages.

    Args:
        plant: The `ContactPlant`.
        scene: The part of it that Drake steps.
        contact: The block of the contact forces in it.
        stages: The stages of its actuation, which are traced; None with rigid joints.
        held_in, put: As `DrakeStepped.held` and `put`.
        values: Values of all its parameters.
    """
    dae, manifold, forces = plant.dae, plant.structure.manifold, contact.contact_force_signals
    positions, results = map(scene.GetOutputPort, ("link_state", "contact_results"))

    count = positions.size()

    def read(context: Context, into: FloatArray) -> None:
        into[:count] = positions.Eval(context)
        # Half the time of evaluating the port of the contact force.
        into[count:] = contact.contact_force(results.Eval(context))

    stepped = DrakeStepped(
        scene,
        plant.time_step,
        ("link_state", "contact_force"),
        "joint_torque",
        "control" if stages is None else "joint_torque",
        held_in,
        put,
        read,
        dae.num_states + len(forces),
    )
    held, parameters = ca.SX.sym("held", stepped.size), ca.DM(values)
    stops = np.cumsum([0, count, len(forces)]).tolist()
    of_links, contact_force, of_stages = ca.vertsplit(held, [*stops, stepped.size])
    state = ca.vertcat(of_links, of_stages)
    normals = contact_normals(plant.robot("contact")).function(state, parameters)[0]
    force = ca.sum1(ca.reshape(normals * contact_force, 3, -1)).T
    acting = ca.SX.sym("force", force.numel())
    expressions = [dae.outputs(acting), manifold.residual_expression]
    symbols = [dae.state, dae.parameter_symbol, acting]
    output, residual = ca.substitute(expressions, symbols, [state, parameters, force])
    shown = {
        "state": state,
        "link_state": of_links,
        "contact_force": contact_force,
        "constraint_force": force,
        "constraint_residual": residual,
        "controlled_output": output,
    }
    updates = []
    if stages is not None:
        shown["joint_torque"] = stages.torque(state, parameters)
        shown |= {name: of_stages[part] for name, part in stages.stage_ports.items()}
        control = ca.SX.sym("control", dae.num_controls)
        after = ca.vertcat(of_links, contact_force, stages.step(state, control, parameters))
        function = ca.Function("step", [held, control], [after])
        updates = [
            Update(Computation(function, (HELD, "control"), (HELD,)), stepped.period, 0.0, True)
        ]
    computations = tuple(
        Computation(ca.Function(name, [held], [value]), (HELD,), (name,))
        for name, value in shown.items()
    )
    ports = {**plant.port_signals, "contact_force": forces}
    return Block(plant, computations, tuple(updates), stepped=stepped, ports=ports)
