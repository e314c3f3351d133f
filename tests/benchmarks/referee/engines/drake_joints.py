"""Drake's MultibodyPlant in continuous time: reaction forces of the joints of its tree.

It has no loops in continuous time, so only mechanisms whose closures are the joints of a tree can
be written: free bodies, each pinned to the world or to another one.
"""

from dataclasses import replace

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from referee.description import Body, Mechanism
from referee.tree import add_tree

NAME = "Drake, joints"
NOTE = "reaction forces of joints in continuous time; trees alone"


def as_tree(mechanism: Mechanism) -> tuple[Mechanism, list[int]]:
    """The mechanism with its closures as joints, and the numbers of the turns that stay."""
    pinned = {closure.body_b: closure for closure in mechanism.closures}
    free = all(body.parent == "world" and slides(body) for body in mechanism.bodies)
    points = all(closure.kind == "point" for closure in mechanism.closures)
    if not (free and points and set(pinned) == {body.name for body in mechanism.bodies}):
        raise NotImplementedError("no loops in continuous time")
    bodies, turns = [], []
    for body in mechanism.bodies:
        closure, first = pinned[body.name], mechanism.first_joint(body.name)
        if any(closure.point_b):
            raise NotImplementedError("the joint is not at the origin of its body")
        kept = [k for k, (kind, _) in enumerate(body.joints) if kind == "turn"]
        turns += [first + k for k in kept]
        joints = tuple(body.joints[k] for k in kept)
        bodies.append(replace(body, joints=joints, parent=closure.body_a, at=closure.point_a))
    return replace(mechanism, bodies=tuple(bodies), torques={}), turns


def slides(body: Body) -> bool:
    """Whether its joints begin with shifts in all directions of its motion."""
    kinds = [kind for kind, _ in body.joints]
    return kinds[:2] == ["slide", "slide"] and (kinds.count("slide") == 3 or kinds == [
        "slide", "slide", "turn"])  # fmt: skip


def relative(tree: Mechanism, turns: list[int], values: np.ndarray) -> np.ndarray:
    """Angles, or rates, of the joints from those of the bodies in the world."""
    own, found = {"world": 0.0}, []
    for body, value in zip(tree.bodies, values[turns], strict=True):
        own[body.name] = value
        found.append(value - own[body.parent])
    return np.array(found)


def forces(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The force of each closure in the components of `force_names`."""
    tree, turns = as_tree(mechanism)
    plant = MultibodyPlant(0.0)
    add_tree(plant, tree)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    chained = any(body.parent != "world" for body in tree.bodies)
    plant.SetPositions(context, relative(tree, turns, q) if chained else q[turns])
    plant.SetVelocities(context, relative(tree, turns, v) if chained else v[turns])
    reactions = plant.get_reaction_forces_output_port().Eval(context)
    found = {}
    for closure, body in zip(mechanism.closures, tree.bodies, strict=True):
        joint = plant.GetJointByName(f"j{tree.first_joint(body.name)}")
        rotation = joint.frame_on_child().CalcRotationMatrixInWorld(context)
        force = rotation @ reactions[int(joint.index())].translational()
        found[closure.name] = force[["xyz".index(axis) for axis in closure.axes]]
    return found
