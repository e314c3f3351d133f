"""Drake's contact results as constraint forces."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import GeometryId
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import Context, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.robots.constraint_wrenches import contact_normals
from drake_dae.robots.model import RobotModel


class ContactForces(LeafSystem):
    """Converts Drake's contact results to the signals of a `RobotModel`.

    A constraint force is the contact force along the normal of its surface, lambda = n(q) . F,
    where n is the gradient of phi and F is the total force on the robot of all contacts (points and
    patches) between the constraint's two geometries. An open contact has lambda = 0 and phi > 0.

    Input ports:
        state: x, shape (n,).
        contact_results: Those of the MultibodyPlant.

    Output ports:
        constraint_force: lambda, N, shape (m,).
        contact_force: F in the world, N, shape (3 m,), constraint by constraint, including
            friction.
        constraint_residual: phi and phi', as for `DaePlant`; not zero, since compliant surfaces are
            penetrated.
        controlled_output: z = l(x) + m(x) lambda.

    Args:
        model: The robot; each constraint is a contact with one force.
        structure: The structure of its system.
        pairs: For each constraint, the geometries of the robot and those of the surface.
        parameters: Values of all parameters.

    Attributes:
        contact_force_signals: Names and units of `contact_force`.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        model: RobotModel,
        structure: ConstraintStructure,
        pairs: Sequence[tuple[Sequence[GeometryId], Sequence[GeometryId]]],
        parameters: FloatArray,
    ) -> None:
        super().__init__()
        self.set_name("contact_forces")
        dae = model.dae
        # Geometry -> the first entry of its constraint's force, and the sign of a force on it as
        # one on the robot. A geometry of the robot collides only with its constraint's surface.
        self._owners = {
            geometry: (3 * number, sign)
            for number, pair in enumerate(pairs)
            for sign, geometries in zip((1.0, -1.0), pair, strict=True)
            for geometry in geometries
        }
        self.contact_force_signals = contact_force_signals(model)
        self._manifold, self._parameters = structure.manifold, parameters
        self._normals = contact_normals(model)
        force = ca.SX.sym("force", dae.num_constraints)
        output = {"value": dae.outputs(force)}
        self._output = dae.trace("controlled output", output, {"force": force})
        self._state = self.DeclareVectorInputPort("state", dae.num_states)
        self._results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        # Ports that others use are computed once; none depends on the time, which changes from a
        # record to the next sample while the state does not.
        sources = {self.all_input_ports_ticket()}
        self._contact, self._constraint, *_ = (
            self.DeclareVectorOutputPort(name, size, port_value(value), sources)
            for name, size, value in (
                ("contact_force", len(self.contact_force_signals), self._contact_force),
                ("constraint_force", dae.num_constraints, self._force),
                ("constraint_residual", len(structure.manifold.residual_signals), self._residual),
                ("controlled_output", dae.num_outputs, self._outputs),
            )
        )

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

    def _force(self, context: Context) -> FloatArray:
        contact = self._contact.Eval(context).reshape(-1, 3)
        state = self._state.Eval(context)
        normals = self._normals.evaluate(state, self._parameters)[0].reshape(-1, 3)
        force: FloatArray = (normals * contact).sum(axis=1)
        return force

    def _residual(self, context: Context) -> FloatArray:
        function = self._manifold.residual_function
        return function.evaluate(self._state.Eval(context), self._parameters)[0]

    def _outputs(self, context: Context) -> FloatArray:
        state, force = self._state.Eval(context), self._constraint.Eval(context)
        return self._output.evaluate(state, force, self._parameters)[0]


def contact_force_signals(model: RobotModel) -> tuple[Signal, ...]:
    """Names and units of the contact forces F of a robot, shape (3 m,)."""
    return tuple(
        Signal(f"{constraint.name}.contact_f{axis}", "N")
        for constraint in model.constraints
        for axis in "xyz"
    )
