"""Mechanisms in space; gravity points along -z, unless stated."""

from referee.description import FREE, Body, Closure, Mechanism, X, Y, Z
from referee.planar import PLANAR_MECHANISMS

LEAST = "least sum of squares of all forces and moments, N^2 + (N m)^2, moments about the point"


def limb(name: str, axis: tuple, parent: str, at: tuple, length: float, mass: float) -> Body:
    """A link of an arm or leg that reaches along z from its joint; downward if length < 0."""
    along = round(mass * 0.0008, 8)
    across = round(mass * length**2 / 12 + along, 8)
    return Body(name, (("turn", axis),), parent, at, mass, (0.0, 0.0, length / 2),
                (across, across, along))  # fmt: skip


TOP = Mechanism(
    "top",
    (
        Body(
            "top",
            (("slide", X), ("slide", Y), ("slide", Z), ("turn", Z), ("turn", X), ("turn", Z)),
            mass=0.8,
            center=(0.0, 0.0, 0.15),
            inertia=(0.004, 0.004, 0.002),
        ),
    ),
    (Closure("tip", "point", "world", (0.0, 0.0, 0.0), "top", (0.0, 0.0, 0.0)),),
    q=(0.0, 0.0, 0.0, 0.3, 0.5, 0.1),
    v={3: 1.0, 4: 0.4, 5: 60.0},
    free=(3, 4, 5),
)

# Rods of 1 m and 1 kg along edges of a cube (IFToMM's benchmark), where q = 0; one edge is fixed.
CORNERS = (
    (0.0, 0.0, 0.0), X, (1.0, 0.0, -1.0), (1.0, 1.0, -1.0), (0.0, 1.0, -1.0), (0.0, 1.0, 0.0),
)  # fmt: skip
HINGES = (Y, Z, X, Y, Z, X)


def between(start: tuple, end: tuple) -> tuple:
    """From one point to another."""
    return tuple(b - a for a, b in zip(start, end, strict=True))


def edge(start: int, end: int, parent: str = "world", origin: tuple = (0.0, 0.0, 0.0)) -> Body:
    """The rod from a corner of the cube, where its hinge is, to another one."""
    way = between(CORNERS[start], CORNERS[end])
    inertia = tuple(0.0008 if abs(part) == 1.0 else 0.084 for part in way)
    at, center = between(origin, CORNERS[start]), tuple(part / 2 for part in way)
    joint = (("turn", HINGES[start]),)
    return Body(f"rod{start}{end}", joint, parent, at, 1.0, center, inertia)


BRICARD = Mechanism(
    "bricard",
    (
        edge(0, 1),
        edge(1, 2, "rod01", CORNERS[0]),
        edge(2, 3, "rod12", CORNERS[1]),
        edge(5, 4),
        edge(4, 3, "rod54", CORNERS[5]),
    ),
    (
        Closure("last", "hinge", "rod23", between(CORNERS[2], CORNERS[3]), "rod43",
                between(CORNERS[4], CORNERS[3]), direction=HINGES[3]),
    ),
    q=(0.3, -0.23, 0.29, 0.23, -0.3),
    v={0: 1.2},
    free=(0,),
    split=LEAST,
)  # fmt: skip

ARM_AXES = (Z, Y, Y, X, Y, X)
ARM_LENGTHS = (0.3, 0.4, 0.35, 0.1, 0.1, 0.05)
ARM_MASSES = (4.0, 3.0, 2.5, 1.0, 0.8, 0.3)


def arm(name: str, base: tuple) -> list[Body]:
    """Six joints in a row; at zero the arm points up."""
    found, parent, at = [], "world", base
    for i, axis in enumerate(ARM_AXES):
        found.append(limb(f"{name}{i}", axis, parent, at, ARM_LENGTHS[i], ARM_MASSES[i]))
        parent, at = f"{name}{i}", (0.0, 0.0, ARM_LENGTHS[i])
    return found


# The box is the last link of the left arm: its joint turns it about x.
TWO_ARMS = Mechanism(
    "two_arms",
    (
        *arm("left", (0.0, 0.0, 0.0)),
        Body("box", (("turn", Z),), "left5", (0.0, 0.0, 0.05), 2.0, (0.15, 0.0, 0.02),
             (0.02, 0.03, 0.035)),
        *arm("right", (1.3, 0.0, 0.0)),
    ),
    (Closure("grip", "weld", "box", (0.3, 0.0, 0.0), "right5", (0.0, 0.0, 0.05)),),
    q=(0.1, 0.6, 0.7, 0.1, -1.25, -0.1, -0.05, -0.05, -0.6, -0.7, 0.05, 1.3, 0.05),
    v={0: 0.3, 1: -0.2, 2: 0.4, 3: 0.1, 4: -0.3, 5: 0.2, 6: 0.15},
    free=(0, 1, 2, 3, 4, 5, 6),
    torques={1: -20.0, 2: -8.0, 8: 15.0, 9: 6.0, 4: 1.0},
)  # fmt: skip


def biped_leg(side: str, y: float) -> list[Body]:
    """Hip about z, x and y, knee about y, ankle about y and x; the foot is the last body."""
    return [
        limb(f"{side}_hip_yaw", Z, "pelvis", (0.0, y, -0.05), -0.05, 1.0),
        limb(f"{side}_hip_roll", X, f"{side}_hip_yaw", (0.0, 0.0, -0.05), -0.05, 1.5),
        limb(f"{side}_thigh", Y, f"{side}_hip_roll", (0.0, 0.0, -0.05), -0.4, 6.0),
        limb(f"{side}_shank", Y, f"{side}_thigh", (0.0, 0.0, -0.4), -0.4, 4.0),
        limb(f"{side}_ankle", Y, f"{side}_shank", (0.0, 0.0, -0.4), -0.04, 0.5),
        Body(f"{side}_foot", (("turn", X),), f"{side}_ankle", (0.0, 0.0, -0.04), 1.2,
             (0.03, 0.0, -0.03), (0.002, 0.005, 0.006)),
    ]  # fmt: skip


HUMANOID = Mechanism(
    "humanoid",
    (
        Body("pelvis", FREE, mass=35.0, center=(0.02, 0.01, 0.25), inertia=(1.8, 1.6, 0.5)),
        *biped_leg("left", 0.1),
        *biped_leg("right", -0.1),
    ),
    (
        Closure("left_sole", "weld", "world", (0.05, 0.11, 0.0), "left_foot", (0.0, 0.0, -0.06)),
        Closure("right_sole", "weld", "world", (-0.1, -0.12, 0.0), "right_foot",
                (0.0, 0.0, -0.06)),
    ),
    q=(0.0, 0.01, 0.95, 0.05, 0.03, -0.02, -0.05, 0.02, -0.5, 0.9, -0.45, 0.0,
       -0.05, 0.02, -0.4, 0.9, -0.5, 0.0),
    v={0: 0.2, 1: -0.1, 2: 0.15, 3: 0.1, 4: -0.2, 5: 0.1},
    free=(0, 1, 2, 3, 4, 5),
    torques={8: 30.0, 9: -90.0, 10: 45.0, 14: 25.0, 15: -85.0, 16: 40.0, 17: 3.0},
)  # fmt: skip

TABLE = Mechanism(
    "table",
    (Body("table", FREE, mass=12.0, center=(0.07, -0.04, 0.6), inertia=(1.1, 1.4, 1.9)),),
    tuple(
        Closure(f"leg{i}", "plane", "world", (0.0, 0.0, 0.0), "table", (x, y, 0.0))
        for i, (x, y) in enumerate(((0.5, 0.3), (-0.5, 0.3), (-0.5, -0.3), (0.5, -0.3)))
    ),
    q=(0.1, 0.2, 0.0, 0.3, 0.0, 0.0),
    v={0: 0.4, 1: -0.3, 3: 1.2},
    free=(0, 1, 3),
    split="least sum of squares of the normal forces, N^2: legs of equal stiffness",
)

GEARS = Mechanism(
    "gears",
    (
        Body("motor", (("turn", X),), mass=0.6, inertia=(0.0004, 0.0003, 0.0003)),
        Body("carrier", (("turn", Z),), "world", (0.2, 0.0, 0.0), 1.2, (0.05, 0.02, 0.0),
             (0.003, 0.004, 0.006)),
        Body("wheel", (("turn", Y),), "carrier", (0.1, 0.0, 0.05), 0.8, (0.01, 0.0, 0.004),
             (0.001, 0.0016, 0.001)),
        Body("drum", (("turn", X),), "world", (0.0, 0.3, 0.0), 2.5, (0.0, 0.01, -0.03),
             (0.01, 0.02, 0.02)),
    ),
    (
        Closure("bevel", "gear", "motor", (0.0, 0.0, 0.0), "carrier", (0.0, 0.0, 0.0), size=-0.5),
        Closure("worm", "gear", "motor", (0.0, 0.0, 0.0), "wheel", (0.0, 0.0, 0.0), size=0.8),
        Closure("belt", "gear", "motor", (0.0, 0.0, 0.0), "drum", (0.0, 0.0, 0.0), size=0.25),
    ),
    q=(0.6, 0.0, 0.0, 0.0),
    v={0: 9.0},
    free=(0,),
    torques={0: 0.4, 3: -0.6},
)  # fmt: skip

MECHANISMS = {
    mechanism.name: mechanism
    for mechanism in (*PLANAR_MECHANISMS, TOP, BRICARD, TWO_ARMS, HUMANOID, TABLE, GEARS)
}
"""All mechanisms of the referee, by name."""
