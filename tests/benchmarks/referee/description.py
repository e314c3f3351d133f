"""The plain description of a mechanism, from which each engine's model and the reference are made.

All frames of bodies are parallel to the world's where the positions are zero; so a mechanism is
points, axes and numbers alone. Each number is exactly its decimal: 0.3 means 3/10. Units are m,
rad, s, kg, N.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

Vector = tuple[float, float, float]

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ORIGIN: Vector = (0.0, 0.0, 0.0)

PLANAR = (("slide", X), ("slide", Y), ("turn", Z))
FREE = (("slide", X), ("slide", Y), ("slide", Z), ("turn", Z), ("turn", Y), ("turn", X))


@dataclass(frozen=True)
class Body:
    """A rigid body that joints, one after the other, connect to its parent.

    Joints are kind, "turn" or "slide", and unit axis, from the parent outward; `at` is the origin
    of the body in its parent where they are at zero. A body without mass carries another one. The
    inertia has the principal ones about the center of mass, along the body's axes.
    """

    name: str
    joints: tuple[tuple[str, Vector], ...] = (("turn", Z),)
    parent: str = "world"
    at: Vector = ORIGIN
    mass: float = 1.0
    center: Vector = ORIGIN
    inertia: Vector = (0.01, 0.01, 0.01)


@dataclass(frozen=True)
class Closure:
    """A constraint between point A on one body and point B on another one.

    Its force is what body A exerts on body B at point B, in the axes of the world:

    - "point": the points coincide along `axes`; the force along these axes.
    - "weld": frames at both points, parallel to the world's where positions are zero, coincide;
      moment and force.
    - "hinge": the points coincide, and the `direction` of both bodies; moment and force.
    - "distance": the points have the distance `size`; the force in the rod, positive if it pushes.
    - "plane": point B is in the plane through A with the normal `direction`, fixed in the world,
      with Coulomb's `friction` while it slides; the force with its friction. The plane may move
      along its normal, with `road`: its velocity and acceleration at the stated time.
    - "gear": the position of `body_b` is `size` times that of `body_a` (one joint each); the moment
      on body B, which gives `size` times the opposite on A.
    """

    name: str
    kind: str
    body_a: str
    point_a: Vector
    body_b: str
    point_b: Vector
    axes: str = "xyz"
    direction: Vector = Z
    size: float = 1.0
    friction: float = 0.0
    road: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Spring:
    """A linear spring between points of two bodies, and its length without force."""

    body_a: str
    point_a: Vector
    body_b: str
    point_b: Vector
    stiffness: float
    length: float


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism in a stated state; joints are numbered in the order of the bodies.

    Each body stands after its parent. Of `q` the positions of `free` joints are exact, the others
    guesses from which Newton's method starts; `v` has the rates of free joints that are not zero.
    The free joints determine all others. `torques` act in joints. If forces are redundant, `split`
    says how they are split.
    """

    name: str
    bodies: tuple[Body, ...]
    closures: tuple[Closure, ...]
    q: tuple[float, ...]
    free: tuple[int, ...]
    v: Mapping[int, float] = field(default_factory=dict)
    gravity: Vector = (0.0, 0.0, -9.81)
    torques: Mapping[int, float] = field(default_factory=dict)
    springs: tuple[Spring, ...] = ()
    split: str = ""

    @property
    def size(self) -> int:
        """The number of joints."""
        return sum(len(body.joints) for body in self.bodies)

    def first_joint(self, name: str) -> int:
        """The number of the first joint of a body."""
        before = self.bodies[: [body.name for body in self.bodies].index(name)]
        return sum(len(body.joints) for body in before)


def force_names(closure: Closure) -> list[str]:
    """The names of the components of a closure's force."""
    force, moment = ["fx", "fy", "fz"], ["mx", "my", "mz"]
    kinds = {
        "point": [f"f{axis}" for axis in closure.axes],
        "weld": moment + force,
        "hinge": moment + force,
        "distance": ["thrust"],
        "plane": force,
        "gear": ["moment"],
    }
    return [f"{closure.name}.{name}" for name in kinds[closure.kind]]
