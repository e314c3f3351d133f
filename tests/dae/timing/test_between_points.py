"""The limits of a time-optimal motion between the points of its grid."""

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_dae import (
    CircleReference,
    JointPositions,
    MotionLimits,
    PathTiming,
    RobotModel,
    TimeOptimalReference,
    find_structure,
)

LINK = """<link name="{0}"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="prismatic"><parent link="{1}"/><child link="{2}"/>
<axis xyz="{3}"/><limit effort="20" velocity="5" lower="-1" upper="1"/></joint>
<transmission name="{0}_drive"><type>transmission_interface/SimpleTransmission</type>
<joint name="{0}"/><actuator name="{0}_motor"/></transmission>"""
TABLE = (
    '<robot name="table">'
    + "".join(LINK.format(name) for name in ("base", "slide", "top"))
    + JOINT.format("x", "base", "slide", "1 0 0")
    + JOINT.format("y", "slide", "top", "0 1 0")
    + "</robot>"
)
MASSES, FORCES = np.array([2.0, 1.0]), np.array([20.0, 10.0])
ACCEPTED = 0.02
"""Of the limits of drives at a few points: less than is left for the feedback."""


def test_limits_hold_between_points_where_an_axis_turns():
    """There the effect of s'' on its force changes its sign, and s'' from one point to the next.

    By Newton's law. The force was 3.3 % too large between 100 points, and 4.1 % between 60.
    """
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(TABLE, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    model = RobotModel.from_multibody(plant, [], [JointPositions(["x", "y"])])
    limits = MotionLimits(controls={"x_motor": (-20.0, 20.0), "y_motor": (-10.0, 10.0)})
    timing = PathTiming(find_structure(model.dae), limits)
    circle = [CircleReference((0.0, 0.0), 0.1, period=2.0)]
    fine = timing.profile(circle, 3.1, points=1000).duration
    for points in (60, 100):
        profile = timing.profile(circle, 3.1, points=points)
        times = np.linspace(0.0, profile.duration, 10_001)
        rows = TimeOptimalReference(profile).pieces((2, 2)).at_all(times)
        share = np.abs(MASSES * rows[:, [2, 5]]).max(axis=0) / FORCES
        assert np.all(share > 0.99)
        assert np.all(share <= 1.0 + ACCEPTED)
        # What a coarse grid costs, of second order in its width.
        assert 1.0 <= profile.duration / fine < 1.0 + 0.02 * (100 / points) ** 2
