"""Pinocchio: `constraintDynamics`, the proximal solver of the KKT system of accelerations."""

import numpy as np
import pinocchio as pin

from referee.description import Mechanism

NAME = "Pinocchio"
NOTE = (
    "constraintDynamics: rigid; proximal with mu = 1e-3, up to 100 iterations to 1e-15, that leads "
    "to the least of redundant forces"
)
PROXIMAL = (1e-15, 1e-3, 100)
KINDS = {"point": pin.ContactType.CONTACT_3D, "weld": pin.ContactType.CONTACT_6D}
REFUSED = {
    "hinge": "no hinge among its constraints",
    "distance": "no rod among its constraints",
    "gear": "no gear among its constraints",
    "plane": "its points are fixed in all directions; contacts that slide are solved for rates, "
    "after a step of time",
}


def model_of(mechanism: Mechanism) -> tuple[pin.Model, dict[str, int]]:
    """The tree, and the number of the last joint of each body."""
    model, last, number = pin.Model(), {"world": 0}, 0
    model.gravity = pin.Motion(np.array(mechanism.gravity), np.zeros(3))
    for body in mechanism.bodies:
        parent, at = last[body.parent], np.array(body.at)
        for kind, axis in body.joints:
            make = {"turn": pin.JointModelRevoluteUnaligned,
                    "slide": pin.JointModelPrismaticUnaligned}[kind]  # fmt: skip
            place = pin.SE3(np.eye(3), at)
            parent = model.addJoint(parent, make(np.array(axis)), place, f"j{number}")
            at, number = np.zeros(3), number + 1
        inertia = pin.Inertia(body.mass, np.array(body.center), np.diag(body.inertia))
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
        last[body.name] = parent
    return model, last


def order(mechanism: Mechanism, model: pin.Model) -> list[int]:
    """The place of each joint of the description in the model's vectors."""
    return [model.idx_vs[model.getJointId(f"j{i}")] for i in range(mechanism.size)]


def solver(mechanism: Mechanism, q: np.ndarray, v: np.ndarray, proximal: tuple = PROXIMAL) -> tuple:
    """`constraintDynamics` at a state, without arguments, and the constraints that it finds."""
    for closure in mechanism.closures:
        if closure.kind in REFUSED:
            raise NotImplementedError(REFUSED[closure.kind])
    model, last = model_of(mechanism)
    data, places = model.createData(), order(mechanism, model)
    own, rate, torque = np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nv)
    own[places], rate[places] = q, v
    for number, value in mechanism.torques.items():
        torque[places[number]] += value
    add_springs(mechanism, model, last, own, torque)
    closures = pin.StdVec_RigidConstraintModel()
    closures.extend(
        pin.RigidConstraintModel(
            KINDS[closure.kind],
            model,
            last[closure.body_b],
            pin.SE3(np.eye(3), np.array(closure.point_b)),
            last[closure.body_a],
            pin.SE3(np.eye(3), np.array(closure.point_a)),
            pin.ReferenceFrame.LOCAL,
        )
        for closure in mechanism.closures
    )
    known = pin.StdVec_RigidConstraintData()
    known.extend(closure.createData() for closure in closures)
    pin.initConstraintDynamics(model, data, closures, known)
    settings, solve = pin.ProximalSettings(*proximal), pin.constraintDynamics
    return lambda: solve(model, data, own, rate, torque, closures, known, settings), known, places


def forces(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The force of each closure in the components of `force_names`."""
    solve, known, _ = solver(mechanism, q, v)
    solve()
    found = {}
    for closure, result in zip(mechanism.closures, known, strict=True):
        rotation, force = result.oMc1.rotation, result.contact_force
        linear = rotation @ force.linear
        if closure.kind == "point":
            found[closure.name] = linear[["xyz".index(axis) for axis in closure.axes]]
        else:
            found[closure.name] = np.concatenate([rotation @ force.angular, linear])
    return found


def add_springs(
    mechanism: Mechanism, model: pin.Model, last: dict[str, int], q: np.ndarray, torque: np.ndarray
) -> None:
    """Pinocchio has no springs: their forces at this state become torques."""
    data = model.createData()
    pin.computeJointJacobians(model, data, q)
    for spring in mechanism.springs:
        ends = [(last[spring.body_a], spring.point_a), (last[spring.body_b], spring.point_b)]
        places = [data.oMi[joint].act(np.array(point)) for joint, point in ends]
        apart = places[1] - places[0]
        length = np.linalg.norm(apart)
        pull = spring.stiffness * (length - spring.length) / length * apart
        for (joint, _), place, force in zip(ends, places, (pull, -pull), strict=True):
            jacobian = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.WORLD)
            torque += jacobian.T @ np.concatenate([force, np.cross(place, force)])
