"""The plain description of a mechanism, from which each engine's model and the reference are made.

All frames of bodies are parallel to the world's where the positions are zero; so a mechanism is
points, axes and numbers alone. Each number is exactly its decimal: 0.3 means 3/10.
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

    Attributes:
        name: Its name.
        joints: Kind, "turn" or "slide", and unit axis of each joint from the parent outward.
        parent: The name of its parent.
        at: The origin of the body in its parent where its joints are at zero, m.
        mass: In kg; 0 only for a body that carries another one.
        center: The center of mass, m.
        inertia: The principal inertias about the center, along the body's axes, kg m^2.
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

    - "point": the points coincide along `axes`; the force along these axes, N.
    - "weld": frames at both points, parallel to the world's where positions are zero, coincide;
      moment, N m, and force, N.
    - "hinge": the points coincide, and the `direction` of both bodies; moment and force.
    - "distance": the points have the distance `size`; the force in the rod, N, positive if it
      pushes.
    - "plane": point B is in the plane through A with the normal `direction`, fixed in the world,
      with Coulomb's `friction` while it slides; the force with its friction, N. The plane may move
      along its normal, with `road`: its velocity, m/s, and acceleration, m/s^2, at the stated time.
    - "gear": the position of `body_b` is `size` times that of `body_a` (one joint each); the moment
      on body B, N m, which gives `size` times the opposite on A.
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
    """A linear spring between points of two bodies.

    Attributes:
        stiffness: In N/m.
        length: Its length without force, m.
    """

    body_a: str
    point_a: Vector
    body_b: str
    point_b: Vector
    stiffness: float
    length: float


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism in a stated state.

    Attributes:
        name: Its name.
        bodies: The bodies, each after its parent.
        closures: The constraints.
        q: The position of each joint, rad or m. Those of `free` joints are exact, the others
            guesses from which Newton's method starts.
        v: Free joint -> its rate, rad/s or m/s; zero if not named.
        free: The numbers of the joints whose rates determine all rates.
        placed: The numbers of the joints whose positions determine all positions: `free` if None.
            They are more if the constraint is nonholonomic.
        gravity: m/s^2.
        torques: Number of a joint -> the torque or force in it, N m or N.
        springs: The springs.
        split: How redundant forces are split, as text; empty if they are not redundant.
        duration: How long the motion lasts after which the forces are compared again, s; 0 for
            none.
    """

    name: str
    bodies: tuple[Body, ...]
    closures: tuple[Closure, ...]
    q: tuple[float, ...]
    free: tuple[int, ...]
    v: Mapping[int, float] = field(default_factory=dict)
    placed: tuple[int, ...] | None = None
    gravity: Vector = (0.0, 0.0, -9.81)
    torques: Mapping[int, float] = field(default_factory=dict)
    springs: tuple[Spring, ...] = ()
    split: str = ""
    duration: float = 0.0

    @property
    def size(self) -> int:
        """The number of joints."""
        return sum(len(body.joints) for body in self.bodies)

    def body(self, name: str) -> Body:
        """The body of that name."""
        return next(body for body in self.bodies if body.name == name)

    def first_joint(self, name: str) -> int:
        """The number of the first joint of a body."""
        before = self.bodies[: [body.name for body in self.bodies].index(name)]
        return sum(len(body.joints) for body in before)


def force_names(closure: Closure) -> list[str]:
    """The names of the components of a closure's force."""
    kinds = {
        "point": [f"f{axis}" for axis in closure.axes],
        "weld": ["mx", "my", "mz", "fx", "fy", "fz"],
        "hinge": ["mx", "my", "mz", "fx", "fy", "fz"],
        "distance": ["thrust"],
        "plane": ["fx", "fy", "fz"],
        "gear": ["moment"],
    }
    return [f"{closure.name}.{name}" for name in kinds[closure.kind]]
