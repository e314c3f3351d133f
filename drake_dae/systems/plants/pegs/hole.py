"""A round peg in a round hole with clearance: the contacts of its axis with a narrower hole."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import casadi as ca

from drake_dae.arrays import unknown_name
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.constraints.friction import Friction
from drake_dae.robots.constraints.points import PointOnSurface
from drake_dae.robots.model import RobotModel
from drake_dae.robots.surfaces.plate import Plate
from drake_dae.systems.plants.contact.contact_material import Peg
from drake_dae.systems.plants.pegs.opening import Opening, opening_of

TINY = 1e-12
"""A distance from the axis of a hole in m below which it has no direction."""


@dataclass(frozen=True, eq=False)
class PegInHole:
    """The contacts of a round peg with a plate that has a round hole.

    The peg is thought of as circles parallel to the face of the plate, with its radius r, about the
    points of its axis. Then it touches a hole of radius R where its axis touches a hole of radius
    c = R - r, the clearance, with the same chamfer: all contacts are those of a line with a plate.
    With the depth h of its tip below the face, the chamfer w, and the distance d of the tip from
    the axis of the hole, they are

        face:     the tip above the face, beside the rim, d > c + w,
        chamfer:  the tip above the cone, c + w - h - d >= 0, while its foot is on the cone,
        side:     the tip in the hole, c - d >= 0, while h > w,
        rim:      the axis at the depth w, d_w <= c, while h > w.

    Gaps are distances: that of the chamfer is divided by sqrt(2), and that of the rim by the
    length of its normal, which is perpendicular to the axis. So forces are normal forces in N, by
    which the hole acts on the axis. Friction acts at the skin of the peg, at a distance r from its
    axis, by the law and the numbers of the constraint. A cylinder that is tilted by an angle a is
    wider along the tilt, by r (1 / cos a - 1), and its end is r sin(a) deeper at one side: 0.8
    micrometers and 0.09 mm for r = 5 mm and 1 degree. The hole has no bottom, and the peg no upper
    end.

    Attributes:
        face: The contact of the tip with the face, which the model has, with the narrower hole.
        openings: The other contacts: chamfer (if there is one), side, and rim.
    """

    face: Opening
    openings: tuple[Opening, ...]


def openings_of(
    model: RobotModel, names: Sequence[str], pegs: Sequence[Peg]
) -> tuple[dict[str, Opening], list[int]]:
    """The contacts of a robot that open and close, with those of its pegs.

    Args:
        model: The robot.
        names: The names of its constraints that open.
        pegs: The pegs.

    Returns:
        Name -> contact, those of constraints first; and for each contact the place among the names
        of the constraint whose coefficient of restitution it has.

    Raises:
        ModelError: A peg does not fit its constraint.
    """
    constraints = {constraint.name: constraint for constraint in model.constraints}
    openings = {name: opening_of(constraints[name], model) for name in names}
    places, entered = list(range(len(names))), set[str]()
    for peg in pegs:
        if peg.constraint not in names:
            raise ModelError(f"peg: {unknown_name('contact that opens', peg.constraint, names)}")
        if peg.constraint in entered:
            raise ModelError(f"peg: '{peg.constraint}' has two pegs; give one")
        entered.add(peg.constraint)
        made = peg_in_hole(constraints[peg.constraint], peg, model)
        openings[peg.constraint] = made.face
        openings |= {opening.name: opening for opening in made.openings}
        places += [names.index(peg.constraint)] * len(made.openings)
    return openings, places


def peg_in_hole(contact: Constraint, peg: Peg, model: RobotModel) -> PegInHole:
    """The contacts of a peg.

    Args:
        contact: The constraint of the tip on the face of a plate with a hole.
        peg: The peg.
        model: The robot.

    Raises:
        ModelError: The constraint has no hole, or friction that is not for a peg; or the peg is too
            thick for the hole.
    """
    plate = contact.surface if isinstance(contact, PointOnSurface) else None
    if not (isinstance(plate, Plate) and plate.hole is not None):
        raise ModelError(
            f"peg: '{contact.name}' has no hole; a peg in ideal contact is for a PointOnSurface on "
            "a Plate with a hole"
        )
    assert isinstance(contact, PointOnSurface)
    hole = plate.hole
    if not peg.radius < hole.radius:
        raise ModelError(
            f"peg: its radius of {peg.radius:g} m leaves no clearance in the hole of "
            f"'{contact.name}', whose radius is {hole.radius:g} m; make it thinner"
        )
    if contact.viscous_friction is not None:
        raise ModelError(
            f"peg: '{contact.name}' has viscous friction, which the sides of a hole "
            "do not have; leave them out"
        )
    c, w = hole.radius - peg.radius, hole.chamfer
    narrow = replace(plate, hole=replace(hole, radius=c))
    narrowed = copy(contact)  # With the same symbols.
    object.__setattr__(narrowed, "surface", narrow)
    face = opening_of(narrowed, model)

    # The tip, and the direction toward it along the axis, in the axes of the plate.
    links = model.links
    tip = links.position(contact.frame, contact.point)
    ahead = ca.mtimes(links.rotation(contact.frame), ca.DM(peg.axis))
    offset = contact.offset_of(tip)
    onward = ca.mtimes(contact.rotation.T, ahead)
    u = narrow.coordinates(offset) - ca.DM(hole.center)
    height, steep = narrow.distance(offset), narrow.distance(onward)
    along = narrow.coordinates(onward)
    inside = -height - w  # How far the tip is below the rim.

    out, d = _radial(u)
    back = inside / steep  # From the tip to the axis at the rim, along the axis.
    out_w, d_w = _radial(u + back * along)
    lean = ca.dot(out_w, along) / steep
    length = ca.sqrt(1.0 + lean**2)
    slant = c + w - d

    normal, e = _axes(contact, narrow, out)
    normal_w, e_w = _axes(contact, narrow, out_w)
    r, at_rim = peg.radius, tip + back * ahead
    touches = [
        ("chamfer", (slant + height) / 2**0.5, (normal - e) / 2**0.5, tip, r * e),
        ("side", c - d, -e, tip, r * e),
        ("rim", (c - d_w) / length, (lean * normal_w - e_w) / length, at_rim, r * e_w),
    ]
    edges = {
        "chamfer": ca.vertcat(slant - height, 2.0 * w - (slant - height)) / 2**0.5,
        "side": inside,
        "rim": inside,
    }
    on_tip = frozenset(contact.name + part for part in ("", ".chamfer", ".side"))
    openings = [
        _opening(
            f"{contact.name}.{name}",
            contact,
            model,
            gap,
            direction,
            point,
            arm,
            edges[name],
            # The axis is below the rim.
            ca.fmax(gap, -inside) if name == "rim" else face.clearance,
        )
        for name, gap, direction, point, arm in touches
        if w or name != "chamfer"
    ]
    # The tip touches one of three faces, and the rim is touched while it is below the rim.
    outside = on_tip - {f"{contact.name}.side"}
    made = [
        replace(each, excludes=outside if each.name not in on_tip else on_tip - {each.name})
        for each in openings
    ]
    return PegInHole(replace(face, excludes=on_tip - {contact.name}), tuple(made))


def _radial(u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The direction away from the axis of the hole, and the distance from it."""
    distance = ca.sqrt(ca.sumsqr(u) + TINY**2)
    return u / distance, distance


def _axes(contact: PointOnSurface, plate: Plate, out: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The normal of the plate, and a direction along it, in the world."""
    offset = ca.SX.sym("offset", 3)
    along = ca.jacobian(plate.coordinates(offset), offset)
    rotation = contact.rotation
    return ca.mtimes(rotation, ca.DM(plate.normal)), ca.mtimes([rotation, along.T, out])


def _opening(
    name: str,
    contact: PointOnSurface,
    model: RobotModel,
    gap: ca.SX,
    normal: ca.SX,
    point: ca.SX,
    arm: ca.SX,
    edges: ca.SX,
    clearance: ca.SX,
) -> Opening:
    """A contact whose normal force acts at a point, and whose friction at its arm from there.

    Args:
        name: The name of the contact.
        contact: The contact with the face, which has the friction.
        model: The robot.
        gap, edges, clearance: As of `Opening`.
        normal: The direction of the normal force, of length one, in the world, shape (3, 1).
        point: A point of the axis in the world, m, shape (3, 1).
        arm: From there to the skin of the peg, m, shape (3, 1).
    """
    links, kinematics = model.links, model.links.kinematics()

    def moved(place: ca.SX) -> ca.SX:
        """J of the velocity of the peg at a place, shape (3, nv)."""
        there = ca.SX.sym("there", 3)
        lever = there - kinematics.position(contact.frame)
        turning = ca.cross(kinematics.angular_velocity(contact.frame), lever)
        velocity = kinematics.value(kinematics.velocity(contact.frame) + turning)
        return ca.substitute(ca.jacobian(velocity, links.v), there, place)

    push, sliding = ca.mtimes(moved(point).T, normal), ca.SX(0, 1)
    if contact.friction is not None:
        skin = moved(point + arm)
        velocity = ca.mtimes(skin, links.v) - contact.surface_velocity(point + arm)
        sliding = velocity - normal * ca.dot(normal, velocity)
        pull = Friction.of(contact.name, contact.parameters, sliding).pull
        push += ca.mtimes(skin.T, pull)
    return Opening(
        name=name,
        edges=edges,
        clearance=clearance,
        sliding=sliding,
        friction=contact.friction_parameter if contact.friction is not None else None,
        gap=gap,
        push=push,
    )
