"""The computations of a `ContactPlant` around the part that Drake steps."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.robots.constraint_wrenches import contact_normals
from drake_dae.systems.blocks.traced import HELD, Block, Computation, DrakeStepped, Update
from drake_dae.systems.plants.contact.stepped_stages import SteppedStages
from drake_dae.systems.plants.contract import Plant


def traced_contact(
    plant: Plant,
    contact_signals: Sequence[Signal],
    stepped: DrakeStepped,
    stages: SteppedStages | None,
    values: FloatArray,
) -> Block:
    """The computations of a `ContactPlant`, whose HELD is (q, v), contact forces, and the stages.

    Args:
        plant: The `ContactPlant`.
        contact_signals: Names and units of the contact forces.
        stepped: The part that Drake steps, with outputs (q, v) and the contact forces.
        stages: The stages of its actuation, which are traced; None with rigid joints.
        values: Values of all its parameters.
    """
    dae, manifold, forces = plant.dae, plant.structure.manifold, len(contact_signals)
    links = stepped.system.GetOutputPort("link_state").size()
    held, parameters = ca.SX.sym("held", stepped.size), ca.DM(values)
    ends = np.cumsum([0, links, forces, stepped.size - links - forces]).tolist()
    of_links, contact, of_stages = ca.vertsplit(held, ends)
    state = ca.vertcat(of_links, of_stages)
    normals = contact_normals(plant.robot("contact")).function(state, parameters)[0]
    force = ca.sum1(ca.reshape(normals * contact, 3, -1)).T
    acting = ca.SX.sym("force", force.numel())
    expressions = [dae.outputs(acting), manifold.residual_expression]
    symbols = [dae.state, dae.parameter_symbol, acting]
    output, residual = ca.substitute(expressions, symbols, [state, parameters, force])
    shown = {
        "state": state,
        "link_state": of_links,
        "contact_force": contact,
        "constraint_force": force,
        "constraint_residual": residual,
        "controlled_output": output,
    }
    updates = []
    if stages is not None:
        shown["joint_torque"] = stages.torque(state, parameters)
        shown |= {name: of_stages[part] for name, part in stages.stage_ports.items()}
        control = ca.SX.sym("control", dae.num_controls)
        after = ca.vertcat(of_links, contact, stages.step(state, control, parameters))
        function = ca.Function("step", [held, control], [after])
        updates = [
            Update(Computation(function, (HELD, "control"), (HELD,)), stepped.period, 0.0, True)
        ]
    computations = tuple(
        Computation(ca.Function(name, [held], [value]), (HELD,), (name,))
        for name, value in shown.items()
    )
    ports = {**plant.port_signals, "contact_force": tuple(contact_signals)}
    return Block(plant, computations, tuple(updates), stepped=stepped, ports=ports)
