"""MuJoCo: the same tree in MJCF, closures as equality constraints and contacts."""

import mujoco
import numpy as np

from referee.description import Closure, Mechanism

NAME = "MuJoCo"
NOTE = (
    "soft constraints: regularized acceleration, impedance at its largest value of 0.9999, "
    "Newton's solver to 1e-15, elliptic cones"
)
HARD = 'solimp="0.9999 0.9999 0.001 0.5 2" solref="-1e-9 -1e-9"'
"""At a consistent state the reference acceleration is zero, so no stiffness is needed."""

# Of the top at q = 0, where its first and last axes are one: MuJoCo writes it into a file.
mujoco.set_mju_user_warning(lambda message: None)

RADIUS = 0.01

SLIDING = 'solreffriction="-1e-9 -15"'
"""Friction that reaches its cone; more would make the normal force larger."""


def numbers(values: object) -> str:
    """Numbers as an attribute."""
    return " ".join(repr(float(value)) for value in values)


def inside(mechanism: Mechanism, name: str, geoms: dict[str, list[str]]) -> str:
    """Sites, geometry and children of a body, in MJCF."""
    lines = list(geoms.get(name, []))
    ends = [(c.name, c.body_a, c.point_a, c.body_b, c.point_b) for c in mechanism.closures]
    ends += [
        (f"spring{i}", s.body_a, s.point_a, s.body_b, s.point_b)
        for i, s in enumerate(mechanism.springs)
    ]
    for own, body_a, point_a, body_b, point_b in ends:
        for suffix, body, point in (("a", body_a, point_a), ("b", body_b, point_b)):
            if body == name:
                lines.append(f'<site name="{own}_{suffix}" pos="{numbers(point)}"/>')
    for body in mechanism.bodies:
        if body.parent != name:
            continue
        lines.append(f'<body name="{body.name}" pos="{numbers(body.at)}">')
        for number, (kind, axis) in enumerate(body.joints, mechanism.first_joint(body.name)):
            kind = {"turn": "hinge", "slide": "slide"}[kind]
            lines.append(f'<joint name="j{number}" type="{kind}" axis="{numbers(axis)}"/>')
        lines.append(
            f'<inertial pos="{numbers(body.center)}" mass="{body.mass!r}" '
            f'diaginertia="{numbers(body.inertia)}"/>'
        )
        lines += [inside(mechanism, body.name, geoms), "</body>"]
    return "".join(lines)


def equality(mechanism: Mechanism, closure: Closure) -> str:
    """An equality constraint; its residual is body B minus body A."""
    name, sites = closure.name, f'site1="{closure.name}_b" site2="{closure.name}_a"'
    if closure.kind == "point":
        return f'<connect name="{name}" {sites} {HARD}/>'
    if closure.kind == "weld":
        return f'<weld name="{name}" {sites} {HARD}/>'
    if closure.kind == "gear":
        leader, follower = (
            mechanism.first_joint(body) for body in (closure.body_a, closure.body_b)
        )
        return (f'<joint name="{name}" joint1="j{follower}" joint2="j{leader}" '
                f'polycoef="0 {closure.size!r} 0 0 0" {HARD}/>')  # fmt: skip
    return ""


def xml(mechanism: Mechanism, geoms: dict[str, list[str]]) -> str:
    """The mechanism in MJCF."""
    tendons = [
        f'<spatial name="spring{i}" stiffness="{s.stiffness!r}" springlength="{s.length!r}">'
        f'<site site="spring{i}_a"/><site site="spring{i}_b"/></spatial>'
        for i, s in enumerate(mechanism.springs)
    ]
    return f"""<mujoco><compiler angle="radian" autolimits="false" boundmass="0"/>
        <option gravity="{numbers(mechanism.gravity)}" solver="Newton" cone="elliptic"
          tolerance="1e-15" iterations="1000" ls_iterations="1000" ls_tolerance="1e-12"
          jacobian="dense"/>
        <worldbody>{inside(mechanism, "world", geoms)}</worldbody>
        <tendon>{"".join(tendons)}</tendon>
        <equality>{"".join(equality(mechanism, c) for c in mechanism.closures)}</equality>
        <contact>{"".join(geoms.get("pairs", []))}</contact>
        </mujoco>"""


def solved(
    mechanism: Mechanism, q: np.ndarray, v: np.ndarray, geoms: dict[str, list[str]]
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The model, and its data after the forward dynamics at a state."""
    model = mujoco.MjModel.from_xml_string(xml(mechanism, geoms))
    data = mujoco.MjData(model)
    for i in range(mechanism.size):
        joint = model.joint(f"j{i}")
        data.qpos[joint.qposadr[0]], data.qvel[joint.dofadr[0]] = q[i], v[i]
        data.qfrc_applied[joint.dofadr[0]] = mechanism.torques.get(i, 0.0)
    mujoco.mj_forward(model, data)
    return model, data


def contact_geoms(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> dict[str, list[str]]:
    """A plane for each contact, and a ball on the body that touches it at the point."""
    touching = [c for c in mechanism.closures if c.kind == "plane"]
    geoms: dict[str, list[str]] = {}
    if not touching:
        return geoms
    model, data = solved(mechanism, q, v, {})
    for closure in touching:
        normal = np.array(closure.direction)
        rotation = data.xmat[model.body(closure.body_b).id].reshape(3, 3)
        center, friction = closure.point_b + RADIUS * rotation.T @ normal, closure.friction
        plane, sphere = (f'name="{closure.name}_{end}" contype="0" conaffinity="0"'
                         for end in ("plane", "ball"))  # fmt: skip
        geoms.setdefault("world", []).append(
            f'<geom {plane} type="plane" size="1 1 1" pos="{numbers(closure.point_a)}" '
            f'zaxis="{numbers(normal)}"/>'
        )
        geoms.setdefault(closure.body_b, []).append(
            f'<geom {sphere} type="sphere" size="{RADIUS}" pos="{numbers(center)}" mass="0"/>'
        )
        geoms.setdefault("pairs", []).append(
            f'<pair geom1="{closure.name}_plane" geom2="{closure.name}_ball" margin="0.001" '
            f'condim="{3 if friction else 1}" friction="{friction} {friction} 0 0 0" {HARD} '
            f"{SLIDING if closure.friction else ''}/>"
        )
    return geoms


def mass_matrix(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """M in the order of the description."""
    model, data = solved(mechanism, q, v, {})
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    order = [model.joint(f"j{i}").dofadr[0] for i in range(mechanism.size)]
    return full[np.ix_(order, order)]


def forces(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The force of each closure in the components of `force_names`."""
    if any(any(closure.road) for closure in mechanism.closures):
        raise NotImplementedError("no constraint that moves with time")
    if any(closure.kind == "hinge" for closure in mechanism.closures):
        raise NotImplementedError("no hinge among the equality constraints")
    model, data = solved(mechanism, q, v, contact_geoms(mechanism, q, v))
    found = {}
    for closure in mechanism.closures:
        if closure.kind == "plane":
            found[closure.name] = contact_force(model, data, closure)
            continue
        number = model.equality(closure.name).id
        rows = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) & (data.efc_id == number)
        force = data.efc_force[rows]
        if closure.kind == "point":
            force = force[["xyz".index(axis) for axis in closure.axes]]
        elif closure.kind == "weld":
            force = np.concatenate([moment(model, data, closure, rows) @ force[3:], force[:3]])
        found[closure.name] = force
    return found


def moment(
    model: mujoco.MjModel, data: mujoco.MjData, closure: Closure, rows: np.ndarray
) -> np.ndarray:
    """The map from the multipliers of a weld's rotation to its moment on B, by its Jacobian."""
    turns = []
    for suffix in "ba":
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, None, jacobian, model.site(f"{closure.name}_{suffix}").id)
        turns.append(jacobian)
    own = data.efc_J.reshape(-1, model.nv)[rows][3:]
    return np.linalg.lstsq((turns[0] - turns[1]).T, own.T, rcond=None)[0]


def contact_force(model: mujoco.MjModel, data: mujoco.MjData, closure: Closure) -> np.ndarray:
    """The force of a contact on the body, in the world."""
    target = data.site(f"{closure.name}_b").xpos
    if not data.ncon:
        raise NotImplementedError("the contact opened")
    near = min(range(data.ncon), key=lambda i: np.linalg.norm(data.contact[i].pos - target))
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, near, force)
    # From the first geometry, the plane, to the second one.
    return data.contact[near].frame.reshape(3, 3).T @ force[:3]
