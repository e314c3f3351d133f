"""The equations of closures, and their forces."""

from collections.abc import Sequence
from dataclasses import dataclass

from mpmath import mp, mpf

from referee.description import Closure, Mechanism
from referee.kinematics import ZERO, Frame
from referee.vectors import IDENTITY, add, apply, cross, dot, exact, scaled, sub, transposed


@dataclass
class Row:
    """One equation: its gap, J of its rate J v - drive, the derivative but J v', and its force."""

    closure: Closure
    gap: object
    gradient: list
    bias: object
    force: list
    drive: object = ZERO


def rows_of(
    mechanism: Mechanism, closure: Closure, bodies: dict[str, Frame], q: Sequence
) -> list[Row]:
    """The equations of a closure."""
    size = mechanism.size
    if closure.kind == "gear":
        follower = mechanism.first_joint(closure.body_b)
        leader = mechanism.first_joint(closure.body_a)
        ratio, gradient = mpf(repr(closure.size)), [ZERO] * size
        gradient[follower], gradient[leader] = mpf(1), -ratio
        return [Row(closure, q[follower] - ratio * q[leader], gradient, ZERO, gradient)]
    frame_a, frame_b = bodies[closure.body_a], bodies[closure.body_b]
    a, b = frame_a.point(exact(closure.point_a)), frame_b.point(exact(closure.point_b))
    W_a, C_a = frame_a.columns(a.place, size)
    W_b, C_b = frame_b.columns(b.place, size)
    apart, moving = sub(b.place, a.place), sub(b.velocity, a.velocity)
    bending = sub(b.acceleration, a.acceleration)

    def shift(u: list, turning: list, gap: object = None) -> Row:
        gradient = [dot(u, sub(C_b[i], C_a[i])) for i in range(size)]
        bias = dot(u, bending) + dot(turning, moving)
        return Row(closure, dot(u, apart) if gap is None else gap, gradient, bias, gradient)

    def turn(u: list, turning: list, gap: object) -> Row:
        gradient = [dot(u, sub(W_b[i], W_a[i])) for i in range(size)]
        bias = dot(u, sub(frame_b.spin_rate, frame_a.spin_rate))
        bias += dot(turning, sub(frame_b.spin, frame_a.spin))
        return Row(closure, gap, gradient, bias, gradient)

    still = [ZERO] * 3
    if closure.kind == "point":
        return [shift(IDENTITY["xyz".index(axis)], still) for axis in closure.axes]
    if closure.kind == "distance":
        length = mp.sqrt(dot(apart, apart))
        away = scaled(1 / length, apart)
        across = scaled(1 / length, sub(moving, scaled(dot(away, moving), away)))
        return [shift(away, across, length - mpf(repr(closure.size)))]
    if closure.kind in ("weld", "hinge"):
        axes_a, axes_b = transposed(frame_a.rotation), transposed(frame_b.rotation)
        if closure.kind == "weld":
            off = add(*(cross(axes_a[k], axes_b[k]) for k in range(3)))
            turns = [turn(u, still, dot(u, off) / 2) for u in IDENTITY]
        else:
            turns, axis = [], exact(closure.direction)
            own, other = apply(frame_a.rotation, axis), apply(frame_b.rotation, axis)
            off = cross(own, other)
            for u in axes_a:
                if dot(u, own) ** 2 < mpf("0.5"):
                    turns.append(turn(u, cross(frame_a.spin, u), dot(u, off)))
        return turns + [shift(u, still) for u in IDENTITY]
    normal = exact(closure.direction)
    if closure.kind == "plane":
        row = shift(normal, still)
        row.drive, moving_up = exact(closure.road)
        row.bias -= moving_up
        friction = mpf(repr(closure.friction))
        along = sub(moving, scaled(dot(normal, moving), normal))
        if friction and any(along):  # It matters in motion alone.
            pull = scaled(-friction / mp.sqrt(dot(along, along)), along)
            row.force = [dot(add(normal, pull), C_b[i]) for i in range(size)]
        return [row]
    # A ball: the material point that touches, at -radius normal from the center, is at rest.
    radius = mpf(repr(closure.size))
    lever = scaled(-radius, normal)
    found = []
    for k, u in enumerate(IDENTITY):
        gradient = [dot(u, add(C_b[i], cross(W_b[i], lever))) for i in range(size)]
        bias = dot(u, add(b.acceleration, cross(frame_b.spin_rate, lever)))
        gap = dot(normal, apart) - radius if abs(normal[k]) == 1 else None
        found.append(Row(closure, gap, gradient, bias, gradient))
    return found


def reported(closure: Closure, bodies: dict[str, Frame], values: Sequence) -> list:
    """The force of a closure in the components of `force_names`, from those of its rows."""
    if closure.kind == "hinge":
        axes = transposed(bodies[closure.body_a].rotation)
        own = apply(bodies[closure.body_a].rotation, exact(closure.direction))
        held = [u for u in axes if dot(u, own) ** 2 < mpf("0.5")]
        moment = add(*(scaled(values[k], u) for k, u in enumerate(held)))
        return [*moment, *values[2:]]
    if closure.kind == "plane":
        normal, friction = exact(closure.direction), mpf(repr(closure.friction))
        force = scaled(values[0], normal)
        if friction:
            moving = bodies[closure.body_b].point(exact(closure.point_b)).velocity
            along = sub(moving, scaled(dot(normal, moving), normal))
            pull = -friction * values[0] / mp.sqrt(dot(along, along))
            force = add(force, scaled(pull, along))
        return force
    return list(values)
