"""Exudyn: every body free, with Euler parameters; joints and closures are constraints alike.

Its solver finds initial accelerations and multipliers, which are read.
"""

import exudyn as exu
import exudyn.itemInterface as item
import numpy as np
from exudyn.utilities import RigidBodyInertia

from referee.description import PLANAR, Body, Closure, Mechanism
from referee.kinematics import frames
from referee.vectors import exact

NAME = "Exudyn"
NOTE = (
    "ideal constraints of all joints in maximal coordinates; the multipliers that belong to its "
    "solver's initial accelerations. Redundant forces as its pivots leave them. Motions by "
    "Newmark's rule of index 2 in 5,000 steps"
)
STEPS = 5_000
"""The steps of a motion."""

REFUSED = {
    "gear": "gears couple coordinates, and joints have none in maximal coordinates",
    "ball": "its rolling joint is that of a thin disc",
}


def frame_along(axis: tuple) -> np.ndarray:
    """A rotation whose third axis is the given unit vector."""
    third = np.array(axis)
    first = np.cross(third, np.eye(3)[np.argmin(np.abs(third))])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(third, first), third])


class Model:
    """The mechanism in a state, assembled and with its initial accelerations solved for."""

    def __init__(self, mechanism: Mechanism, q: np.ndarray, v: np.ndarray, duration: float) -> None:
        self.mbs = exu.SystemContainer().AddSystem()
        self.mechanism = mechanism
        self.frames = frames(mechanism, exact(q), exact(v))
        self.numbers = {"world": self.mbs.CreateGround()}
        self.centers = {"world": np.zeros(3)}
        for body in mechanism.bodies:
            self.add_body(body)
        for body in mechanism.bodies:
            self.add_joint(body)
        self.add_loads()
        self.closures = {c.name: self.add_closure(c) for c in mechanism.closures}
        self.mbs.Assemble()
        if duration:
            try:
                self.mbs.SolveDynamic(settings(duration))
            except exu.SolverError:
                raise NotImplementedError("its solver ends early") from None
            return
        self.solver = exu.MainSolverImplicitSecondOrder()
        if not self.solver.InitializeSolver(self.mbs, settings(1e-6)):
            raise NotImplementedError("its solver found no initial accelerations")

    def rotation(self, name: str) -> np.ndarray:
        """The orientation of a body."""
        return np.array(self.frames[name].rotation, dtype=float)

    def add_body(self, body: Body) -> None:
        """A free body at its center of mass."""
        frame = self.frames[body.name]
        center = frame.point(exact(body.center))
        inertia = RigidBodyInertia(
            mass=body.mass, com=[0.0, 0.0, 0.0], inertiaTensor=np.diag(body.inertia)
        )
        self.centers[body.name] = np.array(body.center)
        self.numbers[body.name] = self.mbs.CreateRigidBody(
            inertia=inertia,
            nodeType=exu.NodeType.RotationEulerParameters,
            referencePosition=[float(x) for x in center.place],
            referenceRotationMatrix=self.rotation(body.name),
            initialVelocity=[float(x) for x in center.velocity],
            initialAngularVelocity=[float(x) for x in frame.spin],
            gravity=list(self.mechanism.gravity),
        )

    def marker(self, name: str, point: tuple) -> int:
        """A marker at a point of a body."""
        local = np.array(point) - self.centers[name]
        return self.mbs.AddMarker(
            item.MarkerBodyRigid(bodyNumber=self.numbers[name], localPosition=local)
        )

    def join(self, a: tuple, b: tuple, held: list[int], turned: np.ndarray | None = None) -> int:
        """A generic joint between points of two bodies."""
        turned = np.eye(3) if turned is None else turned
        return self.mbs.AddObject(
            item.GenericJoint(
                markerNumbers=[self.marker(*a), self.marker(*b)],
                constrainedAxes=held,
                rotationMarker0=turned,
                rotationMarker1=turned,
            )
        )

    def add_joint(self, body: Body) -> None:
        """The joints from the parent to a body as one."""
        kinds = tuple(kind for kind, _ in body.joints)
        ends = (body.parent, body.at), (body.name, (0.0, 0.0, 0.0))
        if len(kinds) == 6:
            return
        if body.joints == PLANAR:
            self.join(*ends, [0, 0, 1, 1, 1, 0])
        elif kinds == ("turn", "turn"):
            self.join(*ends, [1, 1, 1, 0, 0, 1])
        else:
            held = [1, 1, 1, 1, 1, 0] if kinds == ("turn",) else [1, 1, 0, 1, 1, 1]
            self.join(*ends, held, frame_along(body.joints[0][1]))

    def add_loads(self) -> None:
        """Torques in joints, and springs."""
        for number, value in self.mechanism.torques.items():
            body = next(
                b
                for b in self.mechanism.bodies
                if 0 <= number - self.mechanism.first_joint(b.name) < len(b.joints)
            )
            joint = next(j for j in self.frames[body.name].joints if j[0] == number)
            load = value * np.array(joint[2], dtype=float)
            kind = item.LoadTorqueVector if joint[1] == "turn" else item.LoadForceVector
            for name, point, sign in ((body.name, (0.0, 0.0, 0.0), 1.0),
                                      (body.parent, body.at, -1.0)):  # fmt: skip
                if name != "world":
                    marker = self.marker(name, point)
                    self.mbs.AddLoad(kind(markerNumber=marker, loadVector=sign * load))
        for spring in self.mechanism.springs:
            markers = [self.marker(spring.body_a, spring.point_a),
                       self.marker(spring.body_b, spring.point_b)]  # fmt: skip
            self.mbs.AddObject(
                item.SpringDamper(
                    markerNumbers=markers,
                    stiffness=spring.stiffness,
                    damping=0.0,
                    referenceLength=spring.length,
                )
            )

    def add_closure(self, closure: Closure) -> int:
        """The number of its object."""
        ends = (closure.body_a, closure.point_a), (closure.body_b, closure.point_b)
        if closure.kind == "distance":
            markers = [self.marker(*end) for end in ends]
            return self.mbs.AddObject(
                item.DistanceConstraint(markerNumbers=markers, distance=closure.size)
            )
        if closure.kind == "point":
            held = [int(axis in closure.axes) for axis in "xyz"]
            if closure.body_a != "world" and held != [1, 1, 1]:
                # The axes are those of body A, which turns about z alone.
                held = [1, 1, 0]
            return self.join(*ends, [*held, 0, 0, 0])
        if closure.kind == "weld":
            return self.join(*ends, [1, 1, 1, 1, 1, 1])
        if closure.kind == "hinge":
            return self.join(*ends, [1, 1, 1, 1, 1, 0], frame_along(closure.direction))
        return self.join(*ends, [0, 0, 1, 0, 0, 0], frame_along(closure.direction))

    def force(self, closure: Closure) -> np.ndarray:
        """The force on body B in the components of `force_names`."""
        number = self.closures[closure.name]
        if closure.kind == "distance":
            rows = self.mbs.systemData.GetObjectLTGAE(number)
            return -self.mbs.systemData.GetAECoordinates()[rows]
        kinds = exu.OutputVariableType.ForceLocal, exu.OutputVariableType.TorqueLocal
        turned = np.eye(3)
        if closure.body_a != "world":
            kind, body = exu.OutputVariableType.RotationMatrix, self.numbers[closure.body_a]
            turned = self.mbs.GetObjectOutputBody(body, kind, [0.0, 0.0, 0.0]).reshape(3, 3)
        if closure.kind in ("hinge", "plane"):
            turned = turned @ frame_along(closure.direction)
        force, moment = (self.mbs.GetObjectOutput(number, kind) for kind in kinds)
        # These signs make them what acts on body B; found by comparison.
        force, moment = turned @ -force, turned @ (moment * [-1.0, 1.0, 1.0])
        if closure.kind == "point":
            return force[["xyz".index(axis) for axis in closure.axes]]
        return force if closure.kind == "plane" else np.concatenate([moment, force])


def settings(duration: float) -> exu.SimulationSettings:
    """Implicit steps; at the start initial accelerations and multipliers are solved for."""
    found = exu.SimulationSettings()
    found.solutionSettings.writeSolutionToFile = False
    found.timeIntegration.numberOfSteps = STEPS
    found.timeIntegration.endTime = duration
    found.timeIntegration.verboseMode = 0
    # Where rows are redundant, or joints that are cut elsewhere are, it pivots fully.
    found.linearSolverType = exu.LinearSolverType.EigenDense
    found.linearSolverSettings.ignoreSingularJacobian = True
    alpha = found.timeIntegration.generalizedAlpha
    alpha.computeInitialAccelerations = alpha.storeInitialAlgebraicCoordinates = True
    alpha.useIndex2Constraints = alpha.useNewmark = True
    return found


def after(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The forces after the motion from there."""
    return forces(mechanism, q, v, mechanism.duration)


def forces(
    mechanism: Mechanism, q: np.ndarray, v: np.ndarray, duration: float = 0.0
) -> dict[str, np.ndarray]:
    """The force of each closure in the components of `force_names`, after a while."""
    if any(any(closure.road) for closure in mechanism.closures):
        raise NotImplementedError("constraints move with time by functions in Python alone")
    for closure in mechanism.closures:
        if closure.kind in REFUSED:
            raise NotImplementedError(REFUSED[closure.kind])
        if closure.friction:
            raise NotImplementedError("friction is regularized in contacts that are penalties")
    model = Model(mechanism, q, v, duration)
    return {closure.name: model.force(closure) for closure in mechanism.closures}
