"""Windows of rods of 1 m and 1 kg: bars on pivots 1 m apart that couplers join at their tips.

Where bars and couplers lie on one line the gradients of the pins depend on each other: from there
each window may go on as a parallelogram, or crossed, or folded. As parallelograms they are one
pendulum: I a'' = -g S cos a.
"""

from functools import cache

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia

from drake_dae import CoincidentPoints, RobotModel, RobotPlant


@cache
def bars(windows, gravity):
    """The robot and its plant; the pivots stand on a level line."""
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -gravity])
    unit, centre = UnitInertia.ThinRod(1.0, [1.0, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])
    inertia = SpatialInertia(1.0, centre, unit.ShiftFromCenterOfMass(centre))
    pins, end = [], None

    def rod(name, parent, place):
        body = plant.AddRigidBody(name, inertia)
        frame = FixedOffsetFrame(f"{name}_hinge", parent, RigidTransform(place))
        hinge = plant.AddFrame(frame)
        plant.AddJoint(RevoluteJoint(name, hinge, body.body_frame(), [0.0, -1.0, 0.0]))
        return body.body_frame()

    for i in range(windows + 1):
        bar = rod(f"bar{i}", plant.world_frame(), [float(i), 0.0, 0.0])
        if i:
            pin = (f"coupler{i - 1}", (1, 0, 0), f"bar{i}", (1, 0, 0), "xz", f"pin{i}")
            pins.append(CoincidentPoints(*pin))
        if i < windows:
            end = rod(f"coupler{i}", bar if i == 0 else end, [1.0, 0.0, 0.0])
    plant.Finalize()
    nominal = parallelogram(plant, 1.0, 0.0)[: plant.num_positions()]
    model = RobotModel.from_multibody(plant, pins, [], nominal, "bars", forces=[])
    return model, RobotPlant(model)


def parallelogram(plant, angle, rate):
    """The state in which all bars stand at an angle to the line of pivots."""
    q = np.zeros(plant.num_positions())
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if joint.num_positions():
            sign = {"bar": 1.0, "coupler0": -1.0}
            name = joint.name()
            q[joint.position_start()] = sign.get(name[:3], sign.get(name, 0.0))
    return np.concatenate([q * angle, q * rate])
