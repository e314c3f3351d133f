"""Drake's contact results as constraint forces."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import GeometryId
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import Context, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import ConstraintStructure, Signal
from drake_dae.robots import RobotModel, contact_normals


class ContactForces(LeafSystem):
    """Sums Drake's contact results to the forces of a robot's contacts.

    Input port:
        contact_results: Those of the MultibodyPlant.

    Output port:
        contact_force: The total force F on the robot of all contacts (points and patches) between
            the two geometries of each constraint, in the world, N, shape (3 m,), including
            friction.

    Args:
        model: The robot; each constraint is a contact with one force.
        pairs: For each constraint, the geometries of the robot and those of the surface.

    Attributes:
        contact_force_signals: Names and units of `contact_force`.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        model: RobotModel,
        pairs: Sequence[tuple[Sequence[GeometryId], Sequence[GeometryId]]],
    ) -> None:
        super().__init__()
        self.set_name("contact_forces")
        self._model, self._pairs = model, pairs
        # Geometry -> the first entry of its constraint's force, and the sign of a force on it as
        # one on the robot. A geometry of the robot collides only with its constraint's surface.
        self._owners = {
            geometry: (3 * number, sign)
            for number, pair in enumerate(pairs)
            for sign, geometries in zip((1.0, -1.0), pair, strict=True)
            for geometry in geometries
        }
        self.contact_force_signals = contact_force_signals(model)
        self._results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        # Independent of the time, which changes from a record to the next sample while the state
        # does not.
        self.DeclareVectorOutputPort(
            "contact_force",
            len(self.contact_force_signals),
            port_value(self._contact_force),
            {self.all_input_ports_ticket()},
        )

    def again(self) -> "ContactForces":
        """Another instance, for another diagram."""
        return ContactForces(self._model, self._pairs)

    def contact_force(self, results: ContactResults) -> list[float]:
        """The contact forces of Drake's contact results, N: 3 m numbers."""
        # Plain numbers: this runs at each step, and arrays of three numbers take twice the time.
        total = [0.0] * len(self.contact_force_signals)
        for i in range(results.num_point_pair_contacts()):
            point = results.point_pair_contact_info(i)
            # The force is that on B.
            self._add(total, point.point_pair().id_B, point.contact_force())
        for i in range(results.num_hydroelastic_contacts()):
            patch = results.hydroelastic_contact_info(i)
            # The force is that on the body of M.
            self._add(total, patch.contact_surface().id_M(), patch.F_Ac_W().translational())
        return total

    def _add(self, total: list[float], geometry: GeometryId, force: FloatArray) -> None:
        """Adds the force of a contact on a geometry to the forces on the robot."""
        first, sign = self._owners[geometry]
        x, y, z = force.tolist()
        total[first] += sign * x
        total[first + 1] += sign * y
        total[first + 2] += sign * z

    def _contact_force(self, context: Context) -> FloatArray:
        return np.array(self.contact_force(self._results.Eval(context)))


def contact_signals(
    model: RobotModel, structure: ConstraintStructure, parameters: FloatArray
) -> TracedSystem:
    """The signals of a `RobotModel` from its state and contact forces, as a system.

    A constraint force is the contact force along the normal of its surface, lambda = n(q) . F,
    where n is the gradient of phi. An open contact has lambda = 0 and phi > 0.

    Input ports:
        state: x, shape (n,).
        contact_force: F as of `ContactForces`, shape (3 m,).

    Output ports:
        constraint_force: lambda, N, shape (m,).
        constraint_residual: phi and phi', as for `DaePlant`; not zero, since compliant surfaces are
            penetrated.
        controlled_output: z = l(x) + m(x) lambda.

    Args:
        model: The robot; each constraint is a contact with one force.
        structure: The structure of its system.
        parameters: Values of all parameters.
    """
    dae, contact = model.dae, ca.SX.sym("contact_force", 3 * len(model.constraints))
    values = ca.DM(parameters)
    normals = contact_normals(model).function(dae.state, values)[0]
    force = ca.sum1(ca.reshape(normals * contact, 3, -1)).T
    shown = [dae.outputs(force), structure.manifold.residual_expression]
    output, residual = ca.substitute(shown, [dae.parameter_symbol], [values])
    outputs = {
        "constraint_force": force,
        "constraint_residual": residual,
        "controlled_output": output,
    }
    inputs = {"state": dae.state, "contact_force": contact}
    return TracedSystem(Block("contact_signals", inputs, outputs), compiled=dae.compiled)


def contact_force_signals(model: RobotModel) -> tuple[Signal, ...]:
    """Names and units of the contact forces F of a robot, shape (3 m,)."""
    return tuple(
        Signal(f"{constraint.name}.contact_f{axis}", "N")
        for constraint in model.constraints
        for axis in "xyz"
    )
