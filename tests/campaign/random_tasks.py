"""Random tasks of the two-link arm: phases, guards, sensors, pushes, payloads.

Each has to end done, or by the chosen reaction, or with an error of the library, in a time that its
phases and retries allow. Without pushes and payloads the force of every touch has to stay below
the expected peak.
"""

import random
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from campaign.outcomes import HANG, REFUSED, WRONG, Outcome, checked

from drake_dae import load_scenario
from drake_dae.scenario.build import build_completed, roll_scenario
from drake_dae.scenario.start import start_scenario

ENDED = ("done", "held")
REACTIONS = ("hold", "leave")
DURATIONS = (6.0, 60.0)
"""In s; a task that has not ended in the first time is run for the second."""
TEXT = """
robot: {{file: package://drake_dae_models/two_link_arm.urdf}}
constraints:
- name: wall
  frame: tool
  surface: {{point: [1.2, 0, 0], normal: [-1, 0, 0]}}
  friction: 0.0
outputs:
- {{frame: tool, axes: z}}
sampling: {{period: 0.001, delay: 0.001}}
start: {{positions: {{joint1: 1.1653, joint2: -1.8326}}}}
duration: 6
plant: {plant}
sensors: {{force: {sensor}{encoders}}}
{settings}
task:
  tare_time: {tare}
  signals: {signals}
  phases:
{phases}
"""


def random_task(draw: random.Random) -> tuple[str, bool]:
    """A scenario, and whether the touch is that of the model."""
    noise, bias = draw.choice((0.0, 0.1, 0.3)), draw.choice((0.0, 0.0, -1.0, 0.5, 1.0))
    drift = draw.choice((0.0, 0.0, 0.05, -0.05))
    sensor = f"{{sample_period: 0.001, noise_deviation: {noise}, bias: {bias}, drift: {drift}}}"
    settings, moved = [], False
    stiffness, friction = 10 ** draw.uniform(4.0, 6.0), draw.uniform(0.0, 0.6)
    plant = f"radius: 1e-5, stiffness: {stiffness}, friction: {friction}"
    of_velocity = "{position_noise: 1e-5, velocity_noise: 0.005}"
    kinds = ("", "{position_noise: 1e-5}", "{resolution: 2e-5}", of_velocity)
    encoders, unknown = draw.choice(kinds), []
    if draw.random() < 0.4:
        force = [draw.uniform(-60.0, 20.0), 0.0, draw.uniform(-15.0, 15.0)]
        start, end = draw.uniform(0.0, 2.0), draw.uniform(2.0, 3.0)
        push = f"frame: tool, force: {force}, start_time: {start}, end_time: {end}"
        unknown.append(f"disturbances: [{{{push}}}]")
        moved = True
    if draw.random() < 0.3:
        mass = draw.uniform(0.05, 0.6)
        unknown.append(f"payloads: [{{frame: tool, mass: {mass}}}]")
        moved = True
    if draw.random() < 0.3:
        place = 1.2 + draw.uniform(-0.01, 0.08)
        unknown.append(f"parameters: {{wall.position: [{place}, 0, 0]}}")
    if draw.random() < 0.3:
        settings.append("saturation: true")
    after_loss = (*REACTIONS, "approach", "touch", "away")
    retries, spent = draw.randrange(3), draw.choice(("away", *REACTIONS))
    speed, again = draw.uniform(0.01, 0.1), f"retries: {retries}, if_spent: {spent}"
    late = draw.choice((*REACTIONS, "touch", "away"))
    touch = f"name: touch, speed: {speed}, over: 0.1, within: 6, if_late: {late}, {again}"
    if draw.random() < 0.5:
        felt, way = draw.uniform(2.0, 10.0), draw.uniform(0.01, 0.08)
        touch += f", until: [{{of: force, above: {felt}}}], guards: [{{of: travel, above: {way}}}]"
    phases = [f"!Approach {{{touch}}}"]
    ends = f"within: 3, on_failure: {draw.choice(after_loss)}, if_lost: {draw.choice(after_loss)}"
    force, tolerance = draw.uniform(3.0, 40.0), max(1.0, 5.0 * noise)
    guards = _guards(draw, force)
    phases.append(f"!Press {{force: {force}, tolerance: {tolerance}, over: 0.3, {ends}, {guards}}}")
    for _ in range(draw.randrange(4)):
        goal, force, reaction = (
            draw.uniform(0.2, 0.4),
            draw.uniform(3.0, 40.0),
            draw.choice(after_loss),
        )
        goals = f"references: {{tool.z: {goal}, wall.force: {force}}}, duration: 0.6, over: 0.3"
        failing = f"on_failure: {reaction}, {_guards(draw, force)}"
        move, dwell = f"!Move {{{goals}, {failing}}}", "!Dwell {duration: 0.3}"
        ready = "until: [{of: signal, name: ready, above: 0.5}]"
        wait = f"!Dwell {{{ready}, within: 2, {failing}}}"
        phases.append(draw.choice((move, dwell, wait)))
    phases.append("!Release {over: 0.3, within: 3}")
    phases.append("!Retreat {name: away, distance: 0.02, tolerance: 2e-3, within: 5, retries: 0}")
    first = draw.uniform(0.0, 3.0)
    ramp = f"start: [0], end: [1], start_time: {first}, end_time: {first + 0.1}"
    waits = any("ready" in phase for phase in phases)
    text = TEXT.format(
        plant=f"!CompliantContact {{{', '.join([plant, *unknown])}}}",
        sensor=sensor,
        encoders=f", encoders: {encoders}" if encoders else "",
        settings="\n".join(settings),
        tare=0.1 if bias else draw.choice((0.0, 0.1)),
        signals=f"{{ready: !PointToPoint {{{ramp}}}}}" if waits else "{}",
        phases="\n".join(f"  - {phase}" for phase in phases),
    )
    return text, not moved


def _guards(draw: random.Random, force: float) -> str:
    """Guards of a phase that presses with a force in N."""
    found = [
        f"{{of: force, above: {force * draw.uniform(1.2, 3.0)}}}",
        f"{{of: time, above: {draw.uniform(0.7, 3.0)}}}",
        f"{{of: control, above: {draw.uniform(80.0, 150.0)}}}",
        f"{{of: distance, above: {draw.uniform(0.01, 0.1)}}}",
        f"{{of: travel, above: {draw.uniform(0.05, 0.3)}}}",
    ]
    return f"guards: [{', '.join(draw.sample(found, draw.randrange(3)))}]"


def attempt(seed: int, folder: Path) -> Outcome:
    """Runs a random task to its end."""
    text, is_model = random_task(random.Random(seed))
    file = folder / "task.yaml"
    file.write_text(text)
    with checked(f"task {seed}") as outcome:
        for duration in DURATIONS:
            completed, loop = build_completed(load_scenario(file, [f"duration={duration}"]))
            context = start_scenario(completed.scenario, loop)
            found = roll_scenario(completed.scenario, loop, context)
            changes = loop.changes(found.record)
            if found.failure is not None or changes[-1].phase in ENDED:
                break
        limit = re.search(r"stay below ([0-9.e+]+) N", " ".join(completed.notes))
        for before, after in pairwise(changes) if limit and is_model else ():
            record, touch = found.record, after.time
            air = (record.time > before.time) & (record.time < touch)
            # A phase that begins while the tool still presses does not touch.
            is_free = (record["constraint_force"][air, 0] == 0.0).any()
            near = np.abs(record.time - touch - 0.02) < 0.03
            peak = float(np.max(record["constraint_force"][near, 0], initial=0.0))
            if after.in_contact > before.in_contact and is_free and peak > float(limit[1]):
                outcome.kind = WRONG
                outcome.text = f"{peak:.3g} N, expected below {limit[1]} N"
                return outcome
        if found.failure is not None:
            outcome.kind, outcome.text = REFUSED, str(found.failure)
        elif changes[-1].phase not in ENDED:
            outcome.kind, outcome.text = HANG, str(changes[-1])
        else:
            outcome.text = changes[-1].phase
    return outcome
