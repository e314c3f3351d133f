"""Bodies in motion, by the recursion from body to body."""

from collections.abc import Sequence
from dataclasses import dataclass

from mpmath import mp, mpf

from referee.description import Mechanism
from referee.vectors import IDENTITY, add, apply, cross, exact, matmul, scaled, sub, turned

mp.dps = 50
ZERO = mpf(0)


@dataclass
class Frame:
    """A body in motion: pose, velocities, and accelerations for v' = 0, in the world."""

    rotation: list
    position: list
    spin: list
    velocity: list
    spin_rate: list
    acceleration: list
    joints: list  # (number, kind, axis in the world, a point on it) from the world outward

    def point(self, place: Sequence) -> "Point":
        """A point that is fixed in the body."""
        lever = apply(self.rotation, place)
        whirl = cross(self.spin, lever)
        return Point(
            add(self.position, lever),
            add(self.velocity, whirl),
            add(self.acceleration, cross(self.spin_rate, lever), cross(self.spin, whirl)),
        )

    def columns(self, point: Sequence, size: int) -> tuple[list, list]:
        """W and C: what each joint's unit rate gives the body and a point of it."""
        turns, shifts = [[ZERO] * 3] * size, [[ZERO] * 3] * size
        for number, kind, axis, origin in self.joints:
            if kind == "turn":
                turns[number] = axis
                shifts[number] = cross(axis, sub(point, origin))
            else:
                shifts[number] = axis
        return turns, shifts


@dataclass
class Point:
    """A point's place, velocity, and acceleration for v' = 0."""

    place: list
    velocity: list
    acceleration: list


def frames(mechanism: Mechanism, q: Sequence, v: Sequence) -> dict[str, Frame]:
    """All bodies in motion."""
    zero = [ZERO] * 3
    found = {"world": Frame(IDENTITY, zero, zero, zero, zero, zero, [])}
    number = 0
    for body in mechanism.bodies:
        parent = found[body.parent]
        start = parent.point(exact(body.at))
        rotation, place = parent.rotation, start.place
        spin, velocity = parent.spin, start.velocity
        spin_rate, acceleration = parent.spin_rate, start.acceleration
        joints = list(parent.joints)
        for kind, direction in body.joints:
            own = exact(direction)
            axis = apply(rotation, own)
            joints.append((number, kind, axis, place))
            if kind == "turn":
                # The body's own origin is on the axis.
                spin_rate = add(spin_rate, scaled(v[number], cross(spin, axis)))
                spin = add(spin, scaled(v[number], axis))
                rotation = matmul(rotation, turned(own, q[number]))
            else:
                lever = scaled(q[number], axis)
                whirl, along = cross(spin, lever), scaled(v[number], axis)
                acceleration = add(
                    acceleration,
                    cross(spin_rate, lever),
                    cross(spin, whirl),
                    scaled(mpf(2), cross(spin, along)),
                )
                velocity = add(velocity, whirl, along)
                place = add(place, lever)
            number += 1
        found[body.name] = Frame(rotation, place, spin, velocity, spin_rate, acceleration, joints)
    return found
