"""All combinations of parts of a scenario: friction, actuation, sensing, plant, controller."""

from itertools import product
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet
from runs import some

BASE = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- {name: wall, frame: tool, %s, surface: {point: [1.2, 0, 0], normal: [-1, 0, 0]}}
outputs: [{frame: tool, axes: z}]
start: {positions: {joint1: 1.2, joint2: -1.6}}
duration: 0.04
compiled: false
integrator:
  integration_scheme: runge_kutta3
  use_error_control: false
  max_step_size: 1.0e-3
  accuracy: 1.0e-9
"""
FRICTION = {"smooth": "friction: 0.0", "frictional": "friction: 0.3"}
ACTUATION = {
    "rigid": "",
    "springs": "actuation: [!FlexibleJoints {stiffness: 1000.0, inertia: 0.5}]\n",
}
SENSING = {
    "exact": "",
    "encoders": "sensors: {encoders: {resolution: 1.0e-5, velocity_bandwidth: 300}}\n",
    "noise": "sensors: {encoders: {position_noise: 1.0e-6, velocity_noise: 1.0e-4, seed: 3}}\n",
    "force": "sensors: {force: {sample_period: 0.002, noise_deviation: 0.01}}\n",
}
PLANTS = {
    "ideal": "",
    "Drake's contact": "plant: !MultibodyPlant {time_step: 0.001}\n",
    "compliant": "plant: !CompliantContact {time_step: 0.001}\n",
    "continuous": "plant: !CompliantContact {time_step: 0, stiffness: 1.0e+4, "
    "stiction_tolerance: 5.0e-3}\n",
}
"""With a stiction_tolerance of 1e-4 m/s, steps of 1 ms are unstable where a tool behind springs
sticks: they are 8.3 time constants of friction long, and round-off grows by 4.6e11 in a run; now by
62."""
REFERENCES = """law:
  gains: {all: [-10]}
references:
  tool.z: !Sinusoids {offset: 0.3, amplitudes: [0.1], frequencies: [2.0]}
  wall.force: !Sinusoids {offset: 4.0, amplitudes: [10.0], frequencies: [60.0]}
"""
SAMPLED = "sampling: {period: 0.002, delay: 0.001}\n"
TASK = """law:
  gains: {all: [-10]}
task:
  phases:
  - !Press {force: 5, over: 0.01, within: 1.0}
  - !Move {references: {tool.z: 0.31}, duration: 0.01, over: 0.01}
  - !Release {over: 0.01}
"""
CONTROLLERS = {
    "law": REFERENCES,
    "sampled": REFERENCES + SAMPLED,
    "integral": REFERENCES.replace("[-10]}", "[-10, -10, -10]}\n  integral: [tool.z]") + SAMPLED,
    "observer": REFERENCES + SAMPLED + "estimator: {rate: 20.0}\n",
    "limits": REFERENCES + "saturation: true\n",
    "task": TASK,
    "sampled task": TASK + SAMPLED,
    "observed task": TASK + SAMPLED + "estimator: {rate: 20.0}\nsaturation: true\n",
}
PARTS = (FRICTION, ACTUATION, SENSING, PLANTS, CONTROLLERS)
CASES = list(product(*PARTS))


def one_in(count: int) -> list[ParameterSet]:
    """The combinations, of which all but one in so many are thorough.

    A count that shares no factor with the numbers of parts reaches most pairs of them: one in 47
    has all parts, and 143 of the 183 pairs.
    """
    return some(map(pytest.param, CASES), of=count)


def combined(names: tuple[str, ...], folder: Path) -> Path:
    """The file of the scenario with these parts."""
    friction, *parts = (part[name] for part, name in zip(PARTS, names, strict=True))
    path = folder / "scenario.yaml"
    text = BASE % friction + "".join(parts)
    if names[1] == "springs":  # Short phases ask for 1e7 N m of them, and diverge.
        text = text.replace("over: 0.01", "over: 0.3").replace("duration: 0.01", "duration: 0.3")
    path.write_text(text)
    return path
