"""Scenarios as text, of two links at a wall."""

import numpy as np
from runs import run_scenario

from drake_dae.scenario.shipped import find_scenario


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
