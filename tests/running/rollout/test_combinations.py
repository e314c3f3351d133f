"""All combinations of parts of a scenario: a rollout is Drake's run, or one sentence refuses."""

import re
from itertools import product

import numpy as np
import pytest

from drake_dae import build_scenario, load_scenario, rollout, simulate, start_values
from drake_dae.diagrams.state_feedback import encoder_seed
from drake_dae.errors import ModelError, ScenarioError, WiringError

BASE = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- {name: wall, frame: tool, friction: %s, surface: {point: [1.2, 0, 0], normal: [-1, 0, 0]}}
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
FRICTION = {"smooth": "0.0", "frictional": "0.3"}
ACTUATION = {
    "rigid": "",
    "springs": "actuation: [!FlexibleJoints {stiffness: 1000.0, inertia: 0.5}]\n",
}
SENSING = {
    "exact": "",
    "encoders": "encoders: {resolution: 1.0e-5, velocity_bandwidth: 300}\n",
    "noise": "encoders: {position_noise: 1.0e-6, velocity_noise: 1.0e-4, seed: 3}\n",
    "force": "force_feedback: !MeasuredForce {sample_period: 0.002, noise_deviation: 0.01}\n",
}
PLANTS = {
    "ideal": "",
    "opening": "plant: !Unilateral {restitution: {wall: 0.5}}\n",
    "Drake's contact": "plant: !MultibodyPlant {time_step: 0.001}\n",
    "compliant": "plant: !CompliantContact {time_step: 0.001}\n",
    "continuous": "plant: !CompliantContact {time_step: 0, stiffness: 1.0e+4}\n",
}
REFERENCES = """gains: {all: [-10]}
references:
  tool.z: !Sinusoids {offset: 0.3, amplitudes: [0.1], frequencies: [2.0]}
  wall.force: !Sinusoids {offset: 4.0, amplitudes: [10.0], frequencies: [60.0]}
"""
SAMPLED = "sampling: {period: 0.002, delay: 0.001}\n"
TASK = """gains: {all: [-10]}
task:
  phases:
  - !Press {force: 5, over: 0.01, within: 1.0}
  - !Move {references: {tool.z: 0.31}, duration: 0.01, over: 0.01}
  - !Release {over: 0.01}
"""
CONTROLLERS = {
    "law": REFERENCES,
    "sampled": REFERENCES + SAMPLED,
    "integral": REFERENCES.replace("[-10]", "[-10, -10, -10]") + SAMPLED + "integral: [tool.z]\n",
    "observer": REFERENCES + SAMPLED + "observer: {rate: 20.0}\n",
    "limits": REFERENCES + "saturation: true\n",
    "task": TASK,
    "sampled task": TASK + SAMPLED,
    "observed task": TASK + SAMPLED + "observer: {rate: 20.0}\nsaturation: true\n",
}
PARTS = (FRICTION, ACTUATION, SENSING, PLANTS, CONTROLLERS)
CASES = list(product(*PARTS))


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        pytest.param(names, marks=[] if index % 22 == 0 else [pytest.mark.thorough])
        for index, names in enumerate(CASES)
    ],
    ids=", ".join,
)
def test_a_rollout_is_drakes_run_or_says_why_not(names, tmp_path):
    """To 1e-9 of the largest value, away from what happens at a moment that both find."""
    friction, *parts = (part[name] for part, name in zip(PARTS, names, strict=True))
    path = tmp_path / "scenario.yaml"
    text = BASE % friction + "".join(parts)
    if names[1] == "springs":  # Short phases ask for 1e7 N m of them, and diverge.
        text = text.replace("over: 0.01", "over: 0.3").replace("duration: 0.01", "duration: 0.3")
    path.write_text(text)
    try:
        loop, context = build_scenario(load_scenario(path))
    except (ScenarioError, WiringError):
        return  # No scenario at all.
    chosen = load_scenario(path)
    refused = ""
    try:
        start, parameters = start_values(loop, context)
    except ModelError as error:
        refused = str(error)
    if refused:
        assert names[3] == "Drake's contact", refused
        assert re.fullmatch(r"[^.]+(\. [^.]+)?", refused), refused
        return
    seeds = {"force_noise": chosen.force_feedback.seed} if chosen.force_feedback.is_measured else {}
    if chosen.encoders is not None:
        seeds["encoder_noise"] = encoder_seed(chosen.encoders.seed)
    simulate(loop.diagram, context, chosen.duration, chosen.integrator, may_diverge=True)
    wanted = loop.record(context)
    arguments = (loop, start, parameters, wanted.time)
    (found,) = rollout(*arguments, config=chosen.integrator, compiled=False, seeds=[seeds])
    assert found.failure is None
    record = found.record
    assert [str(event.kind) for event in record.events] == [
        str(event.kind) for event in wanted.events
    ]
    moments = [event.time for event in wanted.events]
    if found.context is not None:
        moments += [change.time for change in loop.changes(context)]
    away = np.abs(wanted.time[:, None] - np.array([-1.0, *moments])).min(axis=1) > 1e-9
    away[-2] = False  # Drake adds its steps up, and so may take one of 1e-13 s more.
    for name, recorded in wanted.signals.items():
        if name == "predicted_error":  # It begins anew at a row that is on either side of a change.
            continue
        off = np.abs(record[name] - recorded.values)[away]
        if name == "mode":  # What touches without a force is in either.
            off[np.abs(wanted["constraint_force"] + wanted["gap"])[away] < 1e-9] = 0.0
        assert off.max() < 1e-9 * max(1.0, np.abs(recorded.values).max()), name
