"""Scenarios as text: that of two links at a wall, and a lever of one's own."""

import numpy as np
from runs import run_scenario

from drake_dae import load_scenario
from drake_dae.scenario.shipped import find_scenario

ONE_JOINT = """<robot name="lever"><link name="world"/>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry>{shape}</geometry></visual></link>
  <joint name="joint" type="revolute"><parent link="world"/><child link="arm"/>
    <axis xyz="0 -1 0"/><limit lower="-3" upper="3" velocity="3" effort="40"/></joint>
  <frame name="tip" link="arm" xyz="1 0 0" rpy="0 0 0"/>{drive}</robot>"""


DRIVE = """<transmission><type>transmission_interface/SimpleTransmission</type>
  <joint name="joint"/><actuator name="motor"/></transmission>"""


LEVER = """robot: {file: lever.urdf}
constraints:
- {name: wall, frame: tip, surface: !Plane {point: [0.8, 0, 0], normal: [-1, 0, 0]}}
references: {wall.force: 10}
start: {positions: {joint: 0.6}}
duration: 0.1
"""


def two_link(*settings):
    return load_scenario(find_scenario("two_link_wall"), settings)


def lever(folder, shape='<box size="1 0.1 0.1"/>', drive=DRIVE):
    folder.mkdir(exist_ok=True)
    (folder / "lever.urdf").write_text(ONE_JOINT.format(shape=shape, drive=drive))
    (folder / "lever.yaml").write_text(LEVER)
    return folder / "lever.yaml"


def run(scenario):
    """The loop, its record, and the largest distance of each error from the predicted one."""
    loop, _, record = run_scenario(scenario)
    return loop, record, np.abs(record["tracking_error"] - loop.predicted_error(record)).max(axis=0)


def task_text(phases: str) -> str:
    """A scenario of the two links with these phases, at rest 20 mm before a wall that gives way."""
    return f"""
robot: {{file: package://drake_dae_models/two_link_arm.urdf}}
constraints:
- {{name: wall, frame: tool, surface: {{point: [1.2, 0, 0], normal: [-1, 0, 0]}}}}
outputs:
- {{frame: tool, axes: z}}
law:
  gains: {{all: [-25]}}
  constraint_damping: {{all: [-250]}}
plant: !CompliantContact {{radius: 1.0e-5}}
task:
  gains: {{outputs: {{wall.distance: [-8], "*": [-25]}}}}
  phases:{phases}
start: {{positions: {{joint1: 1.1653, joint2: -1.8326}}}}
duration: 1.0
"""


# At rest 20 mm before the wall, whose friction the law takes for zero.
OBSERVED = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- name: wall
  frame: tool
  surface: {point: [1.2, 0, 0], normal: [-1, 0, 0]}
  friction: 0.0
outputs:
- {frame: tool, axes: z}
law:
  gains: {all: [-25]}
  constraint_damping: {all: [-250]}
sampling: {period: 0.001, delay: 0.001}
sensors:
  force: {sample_period: 0.001, noise_deviation: 0.3}
plant: !CompliantContact {radius: 1.0e-5, friction: 0.3}
estimator: {rate: 60, parameters: [wall.friction]}
task:
  gains: {outputs: {wall.distance: [-8], "*": [-25]}}
  phases:
  - !Approach {speed: 0.1, over: 0.1}
  - !Press {force: 10, over: 0.1}
  - !Move
    references:
      tool.z: !Sinusoids {offset: 0.31, amplitudes: [0.05], frequencies: [2.0]}
      wall.force: 12
    duration: 2.5
    over: 0.5
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
duration: 2.0
"""

SHORT = task_text("""
  - !Approach {speed: 0.1, over: 0.1}
  - !Press {force: 10, over: 0.1}
  - !Move {references: {tool.z: 0.31, wall.force: 12}, duration: 0.2, over: 0.2}
""")
TEXTS = {"task": SHORT, "observed_task": OBSERVED}


def written(name, folder):
    """A text of `TEXTS` as a file in a folder; a shipped scenario's own file."""
    if name not in TEXTS:
        return find_scenario(name)
    (folder / f"{name}.yaml").write_text(TEXTS[name])
    return folder / f"{name}.yaml"
