"""Forces in Drake's own contact: of contacts, as constraint forces, and disturbances."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import GeometryId
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ContactResults, ExternallyAppliedSpatialForce
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, number, positive
from drake_dae.blocks.block import Block, Held, Requirement
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.dae import ConstraintStructure
from drake_dae.errors import ModelError
from drake_dae.references import ExpressionReference
from drake_dae.robots import RobotModel, Vector, contact_normals
from drake_dae.systems.contact_laws import ContactMaterial, ball_normals, point_contacts
from drake_dae.trace.factorization import PositiveDefiniteFactorization


class ContactForces(LeafSystem):
    """Sums Drake's contact results to a force F on the robot of each constraint, shape (3 m,).

    `pairs` are the geometries of the robot, and those of the surface, of each constraint.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, pairs: Sequence[tuple[Sequence[GeometryId], Sequence[GeometryId]]]) -> None:
        super().__init__()
        self.set_name("contact_forces")
        self._pairs = pairs
        # Geometry -> the first entry of its constraint's force, and the sign of a force on it as
        # one on the robot. A geometry of the robot collides only with its constraint's surface.
        self._owners = {
            geometry: (3 * number, sign)
            for number, pair in enumerate(pairs)
            for sign, geometries in zip((1.0, -1.0), pair, strict=True)
            for geometry in geometries
        }
        self._results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        # Independent of the time, which changes from a record to the next sample while the state
        # does not.
        self.DeclareVectorOutputPort(
            "contact_force", 3 * len(pairs), weakly(self._calc), {self.all_input_ports_ticket()}
        )

    def again(self) -> "ContactForces":
        """Another instance."""
        return ContactForces(self._pairs)

    def _calc(self, context: Context, output: BasicVector) -> None:
        results, total = self._results.Eval(context), np.zeros(3 * len(self._pairs))
        points = map(results.point_pair_contact_info, range(results.num_point_pair_contacts()))
        patches = map(results.hydroelastic_contact_info, range(results.num_hydroelastic_contacts()))
        # The force of a point is that on B, that of a patch on the body of M.
        forces = [(each.point_pair().id_B, each.contact_force()) for each in points]
        forces += [(p.contact_surface().id_M(), p.F_Ac_W().translational()) for p in patches]
        for geometry, force in forces:
            first, sign = self._owners[geometry]
            total[first : first + 3] += sign * force
        output.SetFromVector(total)


def contact_block(
    model: RobotModel, structure: ConstraintStructure, values: FloatArray, material: ContactMaterial
) -> Block:
    """The signals of a `RobotModel` in Drake's contact, as a block.

    The contact forces F follow from Drake's generalized ones, tau = J^T F with J of the contact
    points in the configuration of the sample before, for which Drake's solver found them:
    F = (J J^T)^-1 J tau. Where J has no full row rank, they are an input, as of `ContactForces`.
    A constraint force is the one along the normal of its surface, lambda = n(q) . F, where n is the
    gradient of phi. An open contact has lambda = 0 and phi > 0. `values` are all parameters.
    """
    dae, numbers = model.dae, ca.DM(values)
    given, held = ca.SX.sym("contact_force", 3 * len(model.constraints)), dict[str, Held]()
    inputs, contact = {"state": dae.state, "contact_force": given}, given
    required: tuple[Requirement, ...] = ()
    # J of the velocities of all contact points, shape (3 m, nv).
    nominal = structure.manifold.project(dae.nominal_state, values)
    normals = ca.SX.sym("normals", given.numel())
    contacts = point_contacts(model, normals, ca.SX(material.values), material)
    at = ca.Function("n", [dae.state, dae.parameter_symbol], [ball_normals(model)])
    (jacobian,) = ca.substitute(
        [ca.vertcat(*(contact.jacobian for contact in contacts))],
        [normals, dae.parameter_symbol],
        [at(nominal, numbers), numbers],
    )
    rows = ca.Function("J", [dae.state], [jacobian])(nominal).full()
    if np.linalg.matrix_rank(rows, tol=1e-6 * np.linalg.norm(rows)) == len(rows):
        tau, before = ca.SX.sym("tau", rows.shape[1]), ca.SX.sym("before", dae.num_states)
        held["before"] = Held(before, dae.state, nominal, material.time_step)
        J = ca.substitute(jacobian, dae.state, before)
        factors = PositiveDefiniteFactorization(J @ J.T)
        regular = Requirement.regular(factors.pivot, "J J^T of the contact points")
        contact, required = regular.of(factors.solve(J @ tau)), (regular,)
        inputs = {"state": dae.state, "generalized_contact_force": tau}
    normals = contact_normals(model).function(dae.state, numbers)[0]
    force = ca.sum1(ca.reshape(normals * contact, 3, -1)).T
    shown = [dae.outputs(force), structure.manifold.residual_expression]
    output, residual = ca.substitute(shown, [dae.parameter_symbol], [numbers])
    outputs = {
        "contact_force": contact,
        "constraint_force": force,
        "constraint_residual": residual,
        "controlled_output": output,
    }
    return Block("contact_signals", inputs, outputs, held=held, requirements=required)


@checked(ModelError)
@dataclass(frozen=True)
class DisturbanceForce:
    """A disturbance force F on a point of a frame, with a smooth rise and fall:

        F(t) = F (s((t - start_time) / rise) - s((t - end_time) / rise)),    s(x) = 3 x^2 - 2 x^3

    between x = 0 and 1, before it 0 and after it 1.

    Attributes:
        frame: Name of the frame.
        force: F in the world, N, shape (3,).
        start_time: The start, s.
        end_time: The start of the fall, s; None for never.
        rise: The duration of the rise and of the fall, s.
        point: The point in the frame, m, shape (3,).

    Raises:
        ModelError: It ends before it begins, or a number is not valid.
    """

    frame: str
    force: Vector
    start_time: float = 0.0
    end_time: float | None = None
    rise: float = 0.01
    point: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.frame == "world":
            raise ModelError("a disturbance on the world moves nothing; name a frame of the robot")
        positive("the rise of a disturbance", self.rise)
        start = number("the start_time of a disturbance", self.start_time)
        if self.end_time is not None and not self.end_time > start:
            raise ModelError(
                f"a disturbance must end after it begins, at {start:g} s; its end_time is "
                f"{brief(self.end_time)}"
            )

    @property
    def course(self) -> ExpressionReference:
        """The factor of F."""

        def risen(time: ca.SX, start: float) -> ca.SX:
            x = ca.fmin(ca.fmax((time - start) / self.rise, 0.0), 1.0)
            return x * x * (3.0 - 2.0 * x)

        end = np.inf if self.end_time is None else self.end_time
        return ExpressionReference(lambda t: [risen(t, self.start_time) - risen(t, end)])


class AppliedDisturbances(LeafSystem):
    """Applies disturbance forces to the frames of Drake's MultibodyPlant."""

    __slots__ = SHARED_DICTIONARY

    def __init__(self, disturbances: Sequence[DisturbanceForce], frames: Sequence[Frame]) -> None:
        super().__init__()
        self.set_name("disturbances")
        self._arguments = disturbances, frames
        self._courses = [each.course.derivatives([0]) for each in disturbances]
        self._applied = []
        for disturbance, frame in zip(disturbances, frames, strict=True):
            applied = ExternallyAppliedSpatialForce()
            applied.body_index = frame.body().index()
            applied.p_BoBq_B = frame.GetFixedPoseInBodyFrame() @ disturbance.point
            self._applied.append(applied)
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: Value[list[ExternallyAppliedSpatialForce]](),
            weakly(self._calc),
            {self.time_ticket()},
        )

    def again(self) -> "AppliedDisturbances":
        """Another instance."""
        return AppliedDisturbances(*self._arguments)

    def _calc(self, context: Context, output: Value) -> None:
        time = context.get_time()
        every = zip(self._arguments[0], self._applied, self._courses, strict=True)
        for disturbance, applied, course in every:
            force = course(time) * np.array(disturbance.force)
            applied.F_Bq_W = SpatialForce([0.0, 0.0, 0.0], force)
        output.set_value(self._applied)
