"""Random motions within limits: robots, paths, forces, shares, starts, plants.

    python tests/campaign/random_limits.py --count 1000 --seed 0 --out FILE

Each has to end in one of three ways: it is refused in one sentence that MultibodyPlant confirms; it
runs, keeps all limits, and its error is as predicted; or the record says when the error left its
prediction, by how much, and which limit is the cause. `judged_limits.py` has the checks. Returns 1
if one ends otherwise. With `--out` each outcome is a line of that file when it is known, and the
runs in the file are not run again.
"""

import logging
import random
import re
import sys
import sysconfig
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaign.judged_limits import BAD, confirmed, judged, judged_beside
from campaign.seeds import run_seeds

from drake_dae import load_scenario
from drake_dae.dae.references import ConstantReference
from drake_dae.errors import DrakeDaeError
from drake_dae.running.rollout.problems import start_values
from drake_dae.running.rollout.rollout import Rollout, run_loop
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.new.new_scenario import new_scenario
from drake_dae.scenario.rolled import roll_scenario, rollout_times
from drake_dae.scenario.shipped import FOLDER, find_scenario
from drake_dae.scenario.start import start_scenario

PACKAGE = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data").absolute()
VENDORS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "kinova": "kinova_description/robots/kinova.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
}

TRAY = """
robot: {file: tray.urdf, actuators: [tray_x, tray_z]}
constraints:
- !CoincidentPoints {name: grip, frame_a: tray, point_a: [0, 0, 0], frame_b: block,
    point_b: [0, 0, 0], axes: xz}
outputs:
- !JointPositions {joints: [tray_x, tray_z]}
forces: []
gains: !Poles {all: [-4.0]}
references: {"tray_x, tray_z": 0.0}
start: {positions: {tray_x: 0.0}}
"""
"""A tray that carries a block by friction."""


def tray_urdf() -> str:
    """Two bodies of two sliding joints each; those of the tray are driven."""
    link = '<link name="{}"><inertial><mass value="{}"/>{}</inertial></link>'
    inertia = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'
    joint = (
        '<joint name="{0}_{1}" type="prismatic"><parent link="{2}"/><child link="{3}"/>'
        '<axis xyz="{4}"/><limit lower="-5" upper="5" effort="{5}" velocity="3"/></joint>'
    )
    parts = ['<robot name="tray"><link name="world"/>']
    for name, mass, effort in (("tray", 5.0, 120.0), ("block", 2.0, 1.0)):
        parts.append(link.format(f"{name}_slide", 0.1, inertia) + link.format(name, mass, inertia))
        parts.append(joint.format(name, "x", "world", f"{name}_slide", "1 0 0", effort))
        parts.append(joint.format(name, "z", f"{name}_slide", name, "0 0 1", effort))
    return "".join(parts) + "</robot>"


@dataclass
class Base:
    """A robot in a task that random runs change.

    Attributes:
        scenario: The file of its scenario.
        urdf: The robot's file, whose limits are changed.
        robot: Settings of the key `robot` that belong to a copy of that file.
        path: The outputs that a path moves, one or two, such as "tool.yz".
        center, size: The middle of paths, and their largest size, in m.
        force: The contact force, "" without one.
        held: References of the other outputs.
        rows: The number of rows of a record.
    """

    scenario: Path
    urdf: Path
    robot: list[str]
    path: str
    center: list[float]
    size: float
    force: str = ""
    held: dict[str, float] = field(default_factory=dict)
    rows: int = 300

    @property
    def coordinates(self) -> list[str]:
        """The outputs of the path, one name each."""
        if "," in self.path:
            return self.path.split(", ")
        frame, axes = self.path.split(".")
        return [f"{frame}.{axis}" for axis in axes]


@cache
def base_of(name: str, folder: Path) -> Base:
    """A robot by its name; what it needs is written into a folder."""
    models = FOLDER / "models"
    if name == "two_link":
        file, urdf = find_scenario("two_link_wall"), models / "two_link_arm.urdf"
        return Base(file, urdf, [], "tool.z", [0.3], 0.4, "wall.force", rows=600)
    if name == "seven_joint":
        file, urdf = find_scenario("seven_joint_wall"), models / "seven_joint_arm.urdf"
        held = {"tool.z_axis, joint3, joint7": 0.0}
        robot = ["robot.base={weld: base}"]
        return Base(file, urdf, robot, "tool.yz", [0.0, 0.6], 0.2, "wall.force", held)
    if name == "tray":
        (folder / "tray.yaml").write_text(TRAY)
        (folder / "tray.urdf").write_text(tray_urdf())
        urdf = folder / "tray.urdf"
        return Base(folder / "tray.yaml", urdf, [], "tray_x, tray_z", [0.2, 0.0], 1.0, rows=600)
    urdf = PACKAGE / "robots" / VENDORS[name]
    scenario, text = new_scenario(str(urdf), folder=folder)
    (folder / f"{name}.yaml").write_text(text)
    held, path = {}, ""
    for key, reference in scenario.references.items():
        if isinstance(reference, float | ConstantReference):
            held[key] = float(np.ravel(getattr(reference, "values", reference))[0])
        else:
            path, circle = key, reference
    force = next(key for key in held if key.endswith(".force"))
    del held[force]
    center = np.asarray(circle.center).tolist()
    return Base(folder / f"{name}.yaml", urdf, [], path, center, 0.1, force, held)


CHEAP = {"two_link": 76.0, "tray": 8.0}
"""Robots whose runs take about a second, and how often each is drawn, in percent."""


def robots() -> dict[str, float]:
    """The robots that are there, and how often each is drawn."""
    found = [name for name, file in VENDORS.items() if (PACKAGE / "robots" / file).exists()]
    dear = ["seven_joint", *found]
    return {**CHEAP, **dict.fromkeys(dear, (100.0 - sum(CHEAP.values())) / len(dear))}


@dataclass
class Run:
    """A random run.

    Attributes:
        base: The robot.
        settings: Settings of its scenario.
        shares: The shares of the robot's limits.
        forces: The least and the largest contact force in N, None without.
        pole: The poles of the errors, in 1/s.
        cone: The coefficient of friction of a cone, 0 without one.
        friction: Coulomb friction of the contact.
        what: The run in words.
    """

    base: Base
    settings: list[str]
    shares: dict[str, float]
    forces: tuple[float | None, float | None]
    pole: float
    cone: float
    friction: float
    what: str

    @property
    def is_model(self) -> bool:
        """Whether the plant is that of the law."""
        return not self.what.endswith(("compliant", "another mass"))


def random_run(draw: random.Random, folder: Path, among: Mapping[str, float]) -> Run:
    """A random run of one of some robots, whose changed file is written into a folder."""
    name = draw.choices([*among], [*among.values()])[0]
    base = base_of(name, folder)
    slow, weak = draw.uniform(0.15, 1.0), 10 ** draw.uniform(-0.45, 0.0)
    agile = draw.uniform(1.0, 15.0) if draw.random() < 0.5 else 0.0
    copy = folder / f"{name}_limited.urdf"
    copy.write_text(_changed(base.urdf.read_text(), weak, slow, agile))
    settings = [*base.robot, f"robot.file={copy}", "integrator.accuracy=1e-7"]
    settings.append("compiled=false")
    start = draw.choice((0.0, 0.0, 1.3))
    until = start + 10 ** draw.uniform(-0.5, 0.8)
    settings += [f"integrator.start_time={start}", f"duration={until - start}"]
    path, what = _path(draw, base, start, until)
    references: dict[str, Any] = {**path, **base.held}
    least, most, friction, cone = None, None, 0.0, 0.0
    if base.force:
        force = draw.uniform(5.0, 60.0 if name == "two_link" else 25.0)
        wave = f"amplitudes: [{force * draw.uniform(0.0, 0.6)}], frequencies: [2.0]"
        kinds = (force, f"!Sinusoids {{offset: {force}, {wave}}}")
        references[base.force] = draw.choice(kinds)
        if draw.random() < 0.4:
            least, most = force * draw.uniform(0.1, 0.9), force * draw.uniform(1.1, 3.0)
        if draw.random() < 0.15:
            friction = draw.uniform(0.05, 0.5)
            settings.append(f"constraints.0.friction={friction}")
    else:
        cone = draw.uniform(0.1, 0.8)
    settings.append("references={" + ", ".join(f"{k!r}: {v}" for k, v in references.items()) + "}")
    shares = {
        key: draw.uniform(0.6, 0.97) for key in ("efforts", "joint_speeds", "joint_accelerations")
    }
    timing = [f"{key}: {share}" for key, share in shares.items()]
    timing.append(f"points: {draw.choice((100, 300, 1000))}")
    if least is not None:
        timing.append(f"forces: {{{base.force}: [{least}, {most}]}}")
    if cone:
        timing.append(f"cones: [{{normal: grip.fz, tangents: [grip.fx], friction: {cone}}}]")
    if draw.random() < 0.2:
        timing.append(f"largest_rate: {draw.uniform(0.3, 2.0)}")
    errors = {}
    is_governed = draw.random() < 0.85
    if not is_governed:
        timing.append("governor: false")
    elif draw.random() < 0.6:
        errors = {one: draw.uniform(-0.15, 0.15) * base.size for one in base.coordinates}
    settings.append("start.errors={" + ", ".join(f"{k}: {v}" for k, v in errors.items()) + "}")
    pole = -(10 ** draw.uniform(0.3, 1.2))
    settings.append(f"gains.all=[{pole}]")
    settings.append("time_optimal={" + ", ".join(timing) + "}")
    what = f"{name}, {what}" + ", off at the start" * bool(errors) + ", free" * (not is_governed)
    other = draw.random() if name == "two_link" else 1.0
    if other < 0.06:
        stiffness = 10 ** draw.uniform(4.0, 6.0)
        contact = f"radius: 1.0e-5, stiffness: {stiffness}, friction: {draw.choice((0.0, 0.2))}"
        settings.append(f"plant=!CompliantContact {{{contact}}}")
        what += ", compliant"
    elif other < 0.1:
        settings.append(f"plant_parameters={{link2.mass: {draw.uniform(9.0, 11.0)}}}")
        # At a limit an error that is not the model's makes s'' switch, and steps become short.
        settings.append("integrator.use_error_control=false")
        settings.append("integrator.max_step_size=1.0e-3")
        what += ", another mass"
    elif other < 0.12:
        settings.append("actuation=[!FlexibleJoints {stiffness: 8000.0, inertia: 0.5}]")
        what += ", springs"
    return Run(base, settings, shares, (least, most), pole, cone, friction, what)


def _changed(text: str, weak: float, slow: float, agile: float) -> str:
    """A robot's file with other limits: efforts and speeds by factors, and accelerations."""

    def change(found: re.Match[str]) -> str:
        numbers = dict(re.findall(r'([\w:]+)="([^"]+)"', found[0]))
        speed = float(numbers["velocity"]) * slow
        numbers |= {"effort": str(float(numbers["effort"]) * weak), "velocity": str(speed)}
        if agile:
            numbers["drake:acceleration"] = str(agile * speed)
        return "<limit " + " ".join(f'{key}="{value}"' for key, value in numbers.items()) + "/>"

    return re.sub(r"<limit[^>]*>", change, text)


def _path(
    draw: random.Random, base: Base, start: float, until: float
) -> tuple[dict[str, str], str]:
    """References of a path, from a time to a time, and its kind."""
    count, lasts = len(base.coordinates), until - start

    def point() -> list[float]:
        return [middle + base.size * draw.uniform(-0.5, 0.5) for middle in base.center]

    limits = f"limits: {{speed: {draw.uniform(0.5, 2) * base.size}, acceleration: {base.size * 20}"
    limits += f", jerk: {base.size * 500}}}, start_time: {start}"
    kind = draw.choice(("sinusoids", "line", "move", "polyline", "waypoints", "circle"))
    if kind == "circle" and count == 1:
        kind = "sinusoids"
    if kind == "sinusoids":
        texts = {}
        for one, middle in zip(base.coordinates, base.center, strict=True):
            wave = f"offset: {middle}, amplitudes: [{base.size * draw.uniform(0.1, 0.5)}]"
            wave += f", frequencies: [{draw.uniform(1.0, 9.0) / lasts}]"
            texts[one] = f"!Sinusoids {{{wave}, phases: [{draw.uniform(0.0, 6.0)}]}}"
        return texts, kind
    if kind == "line":
        text = f"!Line {{start: {point()}, end: {point()}, {limits}}}"
    elif kind == "move":
        times = f"start_time: {start}, end_time: {until}, order: 4"
        text = f"!PointToPoint {{start: {point()}, end: {point()}, {times}}}"
    elif kind == "polyline":
        points = [point() for _ in range(draw.randrange(2, 5))]
        text = f"!Polyline {{points: {points}, corner: {0.05 * base.size}, {limits}}}"
    elif kind == "waypoints":
        points = [point() for _ in range(draw.randrange(2, 6))]
        times = np.linspace(0.0, lasts, len(points)).tolist()
        text = f"!Waypoints {{points: {points}, times: {times}, start_time: {start}}}"
    else:
        turns, radius = draw.uniform(0.3, 2.0), base.size * draw.uniform(0.1, 0.5)
        own = f"period: {lasts / turns}" if draw.random() < 0.5 else f"{limits}, turns: {turns}"
        phase = f"phase: {draw.uniform(0.0, 6.0)}"
        text = f"!Circle {{center: {base.center}, radius: {radius}, {own}, {phase}}}"
    return {base.path: text}, kind


def outcome(run: Run) -> str:
    """How a run ends; one of `BAD` first where it may not end so."""
    try:
        scenario = load_scenario(run.base.scenario, run.settings)
    except DrakeDaeError as error:
        return f"RAW: {error!r}"
    try:
        completed, loop = build_completed(scenario)
        start, parameters = start_values(loop, start_scenario(completed.scenario, loop))
    except DrakeDaeError as error:
        return confirmed(run, scenario, error)
    except Exception as error:
        return f"RAW: {error!r}"

    def rolled(rows: int) -> Rollout:
        config, lasts = completed.scenario.integrator, completed.scenario.duration
        times = config.start_time + np.linspace(0.0, lasts, rows + 1)
        if not run.is_model:
            times = rollout_times(completed.scenario, loop.plant.time_step)
        (found,) = run_loop(loop, start, parameters, times, config=config)
        return found

    def free() -> float:
        """How far the error of the same run without limits is off its prediction."""
        bare, alone = build_completed(
            load_scenario(run.base.scenario, [*run.settings, "time_optimal.governor=false"])
        )
        found = roll_scenario(bare.scenario, alone, start_scenario(bare.scenario, alone))
        return float(
            np.abs(found.record["tracking_error"] - alone.predicted_error(found.record)).max()
        )

    try:
        found = rolled(run.base.rows)
        if not run.is_model:
            return judged_beside(run, completed, loop, found, free)
        return judged(run, completed, loop, found, lambda: rolled(150 * run.base.rows).record)
    except Exception as error:
        return f"RAW: {error!r}"


def main() -> int:
    warnings.simplefilter("ignore")
    logging.getLogger("drake").setLevel(logging.ERROR)
    among = robots()

    def ended(seed: int, folder: Path) -> str:
        run = random_run(random.Random(seed), folder, among)
        return f"{outcome(run)} [{run.what}]"

    return run_seeds(__doc__, ended, BAD, lambda found: re.split(r"[:,]", found)[0])


if __name__ == "__main__":
    sys.exit(main())
