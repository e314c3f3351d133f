"""Plants of four vendors' arms that no law knows: the bound of their errors beside the errors.

    python examples/bounded_arms [ur5-soft panda-soft ...] [--runs 1000] [--out FOLDER] [--seed 0]
        [--workers 2]

Each arm draws a circle on a table and presses on it with 40 N (kinova, whose joints bear less,
with 20 N), on contact with the equations of Drake's. Ranges are declared: of friction, stiffness,
place and tilt of the table, masses of links, payload, friction of each joint, bias and noise of the
force sensor, and of a push along each axis; controls are late by a random half of a sample. Before
the runs of a class of plants `bound_errors` prints the bound of each output with its causes. Then
plants are drawn from the ranges and run. The robots are those of the package example-robot-data.

Claim: all plants keep their bound, and the median of bound / largest error is at most 5 for
positions and for forces.
"""

import argparse
import json
import logging
import os
import subprocess
import sys
import sysconfig
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import drake_dae as dd
from drake_dae.scenario.files import save_scenario
from drake_dae.scenario.model import scenario_model
from drake_dae.scenario.rolled import for_rollout
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.error_bound import USED
from drake_dae.studies.processes import cores

ROBOTS = Path(
    sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data/robots"
).absolute()

DURATION, AFTER, PUSHED = 2.4, 0.8, 1.6
"""The end of a run, the time from which its errors are bounded, and that of the push, in s."""


@dataclass(frozen=True)
class Arm:
    """An arm, and what disturbs it at most.

    Attributes:
        file: The robot's file.
        links: Two links whose masses are known within 10 %.
        press: The pressing force, in N.
        push: The largest push in each direction, in N.
        tilt: The largest tilt of the table about two axes, in rad.
        payload: The largest payload, in kg.
        friction: The largest Coulomb friction of a joint relative to its effort limit.
    """

    file: str
    links: tuple[str, str]
    press: float = 40.0
    push: float = 20.0
    tilt: float = 0.087
    payload: float = 0.5
    friction: float = 0.02


LIGHT: dict[str, Any] = {"push": 10.0, "tilt": 0.035, "payload": 0.25, "friction": 0.007}
"""What is declared for lighter arms."""

ARMS = {
    "ur5": Arm("ur_description/urdf/ur5_robot.urdf", ("upper_arm_link", "forearm_link")),
    "panda": Arm("panda_description/urdf/panda.urdf", ("panda_link4", "panda_link3"), **LIGHT),
    "kinova": Arm(
        "kinova_description/robots/kinova.urdf",
        ("j2s6s200_link_2", "j2s6s200_link_3"),
        press=20.0,
        **LIGHT,
    ),
    "xarm7": Arm("xarm_description/urdf/xarm7.urdf", ("link2", "link4"), **LIGHT),
}
STIFFNESSES = {
    "soft": (1e4, 4e4),
    "firm": (4e4, 1.7e5),
    "hard": (1.7e5, 7e5),
    "steel": (7e5, 3e6),
}
"""The stiffness of the contact from, to, in N/m."""

KINDS = list(STIFFNESSES)

SAMPLED = {
    "ur5": [(1e-3, 1e-5), (1e-3, 1e-5), (5e-4, 1e-5), (2.5e-4, 3e-6)],
    "panda": [(1e-3, 1e-5), (1e-3, 1e-5), (2.5e-4, 3e-6), (1.25e-4, 1e-6)],
    "kinova": [(1e-3, 1e-5), (5e-4, 1e-5), (2.5e-4, 3e-6), (1.25e-4, 1e-6)],
    "xarm7": [(1e-3, 1e-5), (5e-4, 1e-5), (2.5e-4, 3e-6), (1.25e-4, 1e-6)],
}
"""The sample time in s and the resolution of encoders in rad, for each of `STIFFNESSES`.

A tool of a light arm has a third of the mass, so that it needs shorter samples on the same contact.
1e-5, 3e-6 and 1e-6 rad are 19, 21 and 23 bits of a turn. With shorter samples differences of angles
are rougher, and the gains that are smooth enough become slow.
"""

_FARTHER = (
    "constraints.0.surface.point=[0.23, 0.22, 0.184]",
    "references.link_eef.xy.center=[0.23, 0.22]",
    "references.joint2=-1.03",
    "references.joint7=-1.57",
    "start.positions={joint1: -1.40, joint2: -1.03, joint3: 1.72, joint4: 0.82,"
    " joint5: -1.90, joint6: -1.11, joint7: -1.57}",
)

POSTURES = dict.fromkeys(("xarm7-soft", "xarm7-hard", "xarm7-steel"), _FARTHER)
"""Settings of a class for another place and posture than those that `drake-dae new` chooses.

There the Painleve paradox of xarm7 is at a friction of 0.85, and runs at corners of the ranges
diverge, 12 of 128 on soft contact; here it is at 1.24.
"""


@cache
def nominal(name: str, folder: Path) -> tuple[Scenario, Path]:
    """What `drake-dae new` makes of an arm, and its file in a folder."""
    file = folder / f"{name}.yaml"
    scenario, text = dd.new_scenario(str(ROBOTS / ARMS[name].file), folder=folder)
    file.write_text(text, encoding="utf-8")
    return scenario, file


def scenario_of(name: str, kind: str, folder: Path) -> Scenario:
    """The scenario of an arm on a table, with sensors, late controls and friction of joints."""
    arm = ARMS[name]
    usual, file = nominal(name, folder.parent)
    frame = usual.constraints[0].frame
    joints = ", ".join(usual.start.positions)
    stiffness = STIFFNESSES[kind][1]
    period, resolution = SAMPLED[name][KINDS.index(kind)]
    half = period / 2.0
    settings = [
        "gains=",
        "constraints.0.friction=0.0",
        "constraints.0.rpy=[0.0, 0.0, 0.0]",
        f"references.table.force={arm.press}",
        f"plant=!MultibodyPlant {{time_step: {half}, stiffness: {stiffness}, friction: 0.3}}",
        f"sampling={{period: {period}, delay: {half}, jitter: {half}}}",
        f"encoders={{resolution: {resolution}, velocity_bandwidth: {0.5 / period}}}",
        f"force_feedback=!MeasuredForce {{sample_period: {period}, noise_deviation: 0.1}}",
        f"known_forces=[!JointFriction {{joints: [{joints}]}}]",
        f"plant_payloads=[{{frame: {frame}, mass: 0.01}}]",
        f"plant_disturbances=[{{frame: {frame}, force: [0, 0, 0], start_time: {PUSHED},"
        f" end_time: {PUSHED + 0.1}}}]",
        f"duration={DURATION}",
        *POSTURES.get(f"{name}-{kind}", ()),
    ]
    return for_rollout(dd.load_scenario(file, settings))[0]


def ranges_of(arm: Arm, scenario: Scenario, stiffness: tuple[float, float]) -> dict[str, Any]:
    """What is declared to be unknown, as for `random_variations`."""
    model = scenario_model(scenario)
    values = {p.name: p.value for p in model.dae.parameters}
    x, y, z = values["table.position"].tolist()
    around = {f"{link}.mass": float(values[f"{link}.mass"][0]) for link in arm.links}
    dry = [name for name in values if name.endswith(".coulomb")]
    efforts = dict(zip(dry, model.control_limits.tolist(), strict=True))
    within = f"{-arm.push}..{arm.push}"
    return {
        "plant.friction": (0.05, 0.8),
        "plant.stiffness": stiffness,
        "plant_parameters.table.position": [[x, y, f"{z - 0.002}..{z + 0.002}"]],
        "plant_parameters.table.rpy": [[*[f"{-arm.tilt}..{arm.tilt}"] * 2, 0.0]],
        **{f"plant_parameters.{name}": (0.9 * m, 1.1 * m) for name, m in around.items()},
        "plant_payloads.0.mass": (0.01, arm.payload),
        **{
            f"plant_parameters.{name}": (0.0, min(3.0, arm.friction * effort))
            for name, effort in efforts.items()
        },
        "force_feedback.bias": (-0.3, 0.3),
        "force_feedback.noise_deviation": (0.02, 0.3),
        "plant_disturbances.0.force": [[within, within, within]],
    }


def seeds(count: int, seed: int) -> list[dict[str, int]]:
    """Other seeds of sensors and jitter for each run."""
    own = np.random.default_rng(seed).integers(1, 2**31, count).tolist()
    keys = ("force_feedback.seed", "encoders.seed", "sampling.seed")
    return [dict.fromkeys(keys, number) for number in own]


def run_class(name: str, kind: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Bounds the errors of a class of plants, runs it, and returns its figures.

    `bound.txt`, `bounded.yaml` and the results of all runs are in `folder` then.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = {"arm": name, "kind": kind, "bounded": False}
    try:
        scenario = scenario_of(name, kind, folder)
        ranges = ranges_of(ARMS[name], scenario, STIFFNESSES[kind])
        found = dd.bound_errors(scenario, ranges, after=AFTER)
    except dd.errors.ScenarioError as error:  # No gains are stable at this sample time.
        print(f"{name}, {kind}: {error}", flush=True)
        return missing
    (folder / "bound.txt").write_text(f"{found}\n", encoding="utf-8")
    print(f"{name}, {kind}\n\n{found}\n", flush=True)
    if found.failed:
        return missing
    scenario = found.bounded_scenario
    save_scenario(scenario, folder / "bounded.yaml")
    drawn = dd.random_variations(ranges, count, seed=seed + 1)
    variations = [{**run, **own} for run, own in zip(drawn, seeds(count, seed), strict=True)]
    study = found.study(variations)
    with open(folder / "runs.jsonl", "w", encoding="utf-8") as file:
        for changes, result in zip(study.variations, study.results, strict=True):
            file.write(json.dumps({**result.to_dict(), "variation": changes}) + "\n")
    signals = scenario.error_bound.outputs
    units = {
        each: "m" if each.endswith((".x", ".y")) else "N" if each.endswith(".force") else "rad"
        for each in signals
    }
    # A run has one position: of its coordinates the one that comes closest to its bound counts.
    ratios = {
        unit: (
            1.0
            / np.max(
                [study.values(f"{USED}, {n}") for n, of in units.items() if of == unit], axis=0
            )
        ).tolist()
        for unit in dict.fromkeys(units.values())
    }
    used = study.values(USED)
    return {
        "arm": name,
        "kind": kind,
        "bounded": True,
        "period": scenario.sampling.period,
        "resolution": scenario.encoders.resolution,
        "runs": count,
        "failed": sum(str(result.outcome) != "finished" for result in study.results),
        "held": int(np.sum(used <= 1.0)),
        "worst": float(np.nanmax(used)),
        "ratios": ratios,
        "bound": dict(signals),
    }


def run_classes(
    counts: dict[str, int], seed: int, out: Path, workers: int
) -> Iterator[dict[str, Any]]:
    """Runs classes, those of an arm in one process; returns their figures in the given order."""
    arms = dict.fromkeys(each.split("-")[0] for each in counts)
    if workers > 1 and len(arms) > 1:
        parts = [[each for each in counts if each.startswith(f"{arm}-")] for arm in arms]
        with ThreadPoolExecutor(workers) as pool:
            calls = [pool.submit(run_apart, part, counts, seed, out) for part in parts]
            for call in calls:
                print(call.result(), flush=True)
    else:
        for each, count in counts.items():
            row = run_class(*each.split("-"), count, seed, out / each)
            (out / each / "row.json").write_text(json.dumps(row))
            print({key: value for key, value in row.items() if key != "ratios"}, flush=True)
    for each in counts:
        yield json.loads((out / each / "row.json").read_text())


def run_apart(classes: Sequence[str], counts: dict[str, int], seed: int, out: Path) -> str:
    """Runs classes in a process of their own; returns what it prints."""
    asked = [f"{each}={counts[each]}" for each in classes]
    command = [sys.executable, __file__, *asked, "--seed", str(seed), "--out", str(out)]
    done = subprocess.run(
        [*command, "--workers", "1", "--no-table"],
        stdout=subprocess.PIPE,
        env={"OMP_NUM_THREADS": "1", **os.environ},
        text=True,
        check=True,
    )
    return done.stdout


def show_table(rows: Sequence[dict[str, Any]]) -> int:
    """Prints a table; returns 0 if every class has a bound, and all plants keep it.

    The median of bound / error is at most 5 then, both of positions and of forces.
    """
    print(
        f"\n{'arm':8}{'contact':9}{'samples':>9}{'encoder':>9}{'runs':>6}{'held':>6}"
        f"{'failed':>7}{'bound / error: m':>18}{'N':>6}{'rad':>6}"
    )
    done = [row for row in rows if row["bounded"]]
    for row in done:
        medians = "".join(
            f"{np.nanmedian(row['ratios'][unit]):{w}.2f}"
            for unit, w in (("m", 18), ("N", 6), ("rad", 6))
        )
        print(
            f"{row['arm']:8}{row['kind']:9}{1e3 * row['period']:6.3g} ms{row['resolution']:9.0e}"
            f"{row['runs']:6}{row['held']:6}{row['failed']:7}{medians}"
        )
    for row in rows:
        if not row["bounded"]:
            print(f"{row['arm']:8}{row['kind']:9} no bound: see above")
    if not done:
        return 1
    total, held = sum(row["runs"] for row in done), sum(row["held"] for row in done)
    median = {
        unit: float(np.nanmedian(np.concatenate([row["ratios"][unit] for row in done])))
        for unit in ("m", "N", "rad")
    }
    print(f"{held} of {total} within their bound; median of bound / error: {median}")
    is_held = held == total and len(done) == len(rows)
    return 0 if is_held and max(median["m"], median["N"]) <= 5.0 else 1


def main(arguments: list[str] | None = None) -> int:
    """Runs the classes of the command line; returns what `show_table` returns."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=1000, help="of all classes together")
    parser.add_argument("--out", type=Path, default=Path("runs/unknowns"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=cores(), help="processes; one has an arm")
    parser.add_argument("--no-table", action="store_true", help="the runs alone")
    classes = [f"{name}-{kind}" for name in ARMS for kind in STIFFNESSES]
    text = f"any of {', '.join(classes)}; ur5-soft=63 has 63 runs"
    parser.add_argument("classes", nargs="*", help=text)
    options = parser.parse_args(arguments)
    chosen = options.classes or classes
    counts = {}
    for i, each in enumerate(chosen):
        name, _, count = each.partition("=")
        if name not in classes or not (count or "1").isdecimal():
            parser.error(f"{each} is no class of plants; it must be {text}")
        share = options.runs // len(chosen) + (i < options.runs % len(chosen))
        counts[name] = int(count) if count else share
    rows = list(run_classes(counts, options.seed, options.out, options.workers))
    return 0 if options.no_table else show_table(rows)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.getLogger("drake").setLevel(logging.ERROR)
    sys.exit(main())
