"""The task of `polish_unknown_part` on a vendor's arm: a UR5 over a table.

    python examples/arms [--out FOLDER] [--set KEY=VALUE] [--rollout]

The robot is that of the package example-robot-data. The run makes its folder with record, pictures
and summary, as `drake-dae simulate` does with the same settings. The exit code is 1 if it is not
good.
"""

import argparse
import sys
import sysconfig
from pathlib import Path

from drake_dae.cli import main as command

DATA = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data").absolute()
"""The package example-robot-data."""

START = {
    "shoulder_pan_joint": -0.245,
    "shoulder_lift_joint": -1.6587,
    "elbow_joint": 1.9171,
    "wrist_1_joint": -1.8292,
    "wrist_2_joint": -1.5708,
    "wrist_3_joint": -1.8158,
}
"""The joint positions 30 mm above the table."""

EIGHT = (
    "tool.x: !Sinusoids {offset: 0.45, amplitudes: [0.06], frequencies: [2.0]}, "
    "tool.y: !Sinusoids {offset: 0.0, amplitudes: [0.07], frequencies: [1.0]}"
)


def settings() -> list[str]:
    """The settings by which the arm polishes a part on its table.

    The part is 5 mm and 5 degrees off where the law has it, as in the shipped scenario.
    """
    file = Path(__file__).parent / "ur5.dmd.yaml"
    start = ", ".join(f"{joint}: {value}" for joint, value in START.items())
    force = "!Sinusoids {offset: 20.0, amplitudes: [5.0], frequencies: [2.0]}"
    outputs = (
        "{frame: tool, axes: xy}, !TiltFromNormal {constraint: part, axis: z}, "
        "!JointPositions {joints: [wrist_3_joint]}"
    )
    return [
        f"robot={{file: '{file}', packages: {{example-robot-data: '{DATA}'}}}}",
        f"start.positions={{{start}}}",
        "constraints.0.surface.point=[0.45, 0.0, 0.2]",
        "constraints.0.surface.normal=[0.0, 0.0, 1.0]",
        f"outputs=[{outputs}]",
        "plant.parameters={part.position: [0.4526, 0.003, 0.203], part.rpy: [0.056, 0.06, 0.03]}",
        "bounds.part.position=[[0.44, -0.01, 0.19], [0.46, 0.01, 0.21]]",
        f"task.phases.3.references={{{EIGHT}, part.force: 10.0}}",
        f"task.phases.4.references={{{EIGHT}, part.force: {force}}}",
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/arms"), help="default: runs/arms")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--rollout", action="store_true", help="as one compiled function")
    options = parser.parse_args(arguments)
    sets = [part for each in (*settings(), *options.set) for part in ("--set", each)]
    more = ["--rollout"] if options.rollout else []
    return command(["simulate", "polish_unknown_part", "--out", str(options.out), *more, *sets])


if __name__ == "__main__":
    sys.exit(main())
