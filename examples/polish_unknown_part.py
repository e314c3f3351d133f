"""A part 5 mm and 5 degrees off its place: the tool feels for it, finds its place, and polishes it.

The part is a mesh with a bump of 5 mm. The law's model has it at x = 1.2 m; the plant's is 5 mm
farther, and tilted by 5 degrees about y. Two guarded moves touch it. Position and tilt follow from
the distance by the law's model, which has to be zero at both touches. Then the law polishes.

Claims: the place is found within 0.05 mm and 0.05 degrees; with it the errors of path and force are
at most a tenth of those without, in Drake's contact of 1e5 N/m with friction that no law knows.

    python examples/polish_unknown_part.py [FOLDER]
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import least_squares

import drake_dae as dd

CLAIMS = 0.05, 0.05, 0.1
"""The largest errors of the place in mm and of the tilt in degrees, and the largest share of the
errors of path and force that is left."""

PLACE, TILT = [1.205, 0.0, 0.3], float(np.deg2rad(5.0))
SCENARIO = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- name: part
  frame: tool
  surface: !MeshSurface {file: part.obj, point: [1.2, 0, 0.3], normal: [-1, 0, 0]}
  rpy: [0, 0, 0]
  friction: 0
outputs:
- !PointCoordinates {frame: tool, axes: z}
plant: !CompliantContact {radius: 1.0e-5, stiffness: 1.0e5, friction: 0.3}
sampling: {period: 0.001, delay: 0.001}
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
"""
FEEL = "- !GuardedMove {name: NAME, distance: 0.06, speed: 0.02, force: 2, over: 0.2}"
LEAVE = "- !Release {over: 0.2}\n- !Retreat {distance: 0.03, over: 0.5, tolerance: 0.002}"
ALONG = "- !Move {references: {tool.z: 0.4, part.distance: 0.03}, over: 1, duration: 1.2}"
TOUCHES = [FEEL.replace("NAME", "first"), LEAVE, ALONG, FEEL.replace("NAME", "second"), LEAVE]
POLISH = """
- !Approach {speed: 0.02}
- !Press {force: 15, over: 0.2}
- !Move
  name: polish
  references:
    tool.z: !Sinusoids {offset: 0.3, amplitudes: [0.08], frequencies: [2]}
    part.force: 15
  over: 1
  duration: 5
"""


def write_part(file: Path) -> None:
    """Writes the mesh, whose bump towards the robot is 5 mm high."""
    heights, sides = np.linspace(-0.2, 0.2, 41), (-0.1, 0.0, 0.1)
    corners = [
        f"v {-0.005 * np.exp(-((z / 0.1) ** 2)):.6f} {y} {z:.4f}" for z in heights for y in sides
    ]
    faces = []
    for first in (3 * row + column + 1 for row in range(40) for column in range(2)):
        faces += [f"f {first} {first + 3} {first + 1}", f"f {first + 1} {first + 3} {first + 4}"]
    file.write_text("\n".join([*corners, *faces]) + "\n")


def run(folder: Path, phases: str, duration: float, place, tilt: float) -> tuple:
    """The record and the phases of a task under a law that has the part at a place."""
    file = folder / "part.yaml"
    task = "\n".join(f"  {line}" for line in phases.strip().splitlines())
    known = {"part.position": [float(number) for number in place], "part.rpy": [0.0, tilt, 0.0]}
    plant = {"part.position": PLACE, "part.rpy": [0.0, TILT, 0.0]}
    text = f"{SCENARIO}parameters: {known}\nplant_parameters: {plant}\nduration: {duration}\n"
    file.write_text(f"{text}task:\n  phases:\n{task}\n")
    loop, context = dd.build_scenario(dd.load_scenario(file))
    times = np.linspace(0.0, duration, round(1000 * duration) + 1)
    (rolled,) = dd.rollout(loop, *dd.start_values(loop, context), times)
    return loop, rolled.record, loop.changes(rolled.context)


def found_place(loop, record, changes) -> tuple[np.ndarray, float]:
    """The place and the tilt at which the law's model has the tool on the surface at each touch."""
    dae = loop.controller.law.system
    touched = [after.time for after in changes if after.phase.startswith("Release")]
    states = [record["state"][np.searchsorted(record.time, time) - 1] for time in touched]
    distance = dae.trace("distance", {"value": dae.k})

    def distances(guess):
        place = {"part.position": [guess[0], 0, 0.3], "part.rpy": [0, guess[1], 0]}
        parameters = dae.with_values(place).parameter_values
        return [distance(state, parameters)[0][0] for state in states]

    offset, tilt = least_squares(distances, [1.2, 0.0], xtol=1e-15).x
    return np.array([offset, 0.0, 0.3]), float(tilt)


def figures(record, changes) -> tuple[float, float]:
    """The rms errors of the path in mm and of the force in N while it polishes, after 2 s."""
    begin = next(change.time for change in changes if change.phase == "polish") + 2.0
    late = (record.time > begin) & (record.time < begin + 3.0)
    errors = record["tracking_error"][late]
    path, force = np.sqrt(np.mean(errors[:, :2] ** 2, axis=0))
    return 1e3 * path, force


def main(folder: Path) -> tuple[float, ...]:
    """Returns the errors of place in mm and tilt in degrees, and the shares of both errors left."""
    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
    with TemporaryDirectory() as name:
        files = Path(name)
        write_part(files / "part.obj")
        touched = run(files, "\n".join(TOUCHES), 6.5, [1.2, 0.0, 0.3], 0.0)
        place, tilt = found_place(*touched)
        errors = []
        for title, *known in (("as drawn", [1.2, 0.0, 0.3], 0.0), ("as found", place, tilt)):
            _, record, changes = run(files, POLISH, 7.0, *known)
            errors.append(figures(record, changes))
            print(f"polished {title}: {errors[-1][0]:.4f} mm, {errors[-1][1]:.4f} N rms")
            axes[0].plot(record.time, 1e3 * record["tracking_error"][:, 0], label=title)
            axes[1].plot(record.time, record["constraint_force"][:, 0], label=title)
    off, angle = 1e3 * abs(place[0] - PLACE[0]), float(abs(np.rad2deg(tilt - TILT)))
    path, force = (after / before for before, after in zip(*errors, strict=True))
    print(f"place off by {off:.3f} mm (claim: {CLAIMS[0]})")
    print(f"tilt off by {angle:.3f} degrees (claim: {CLAIMS[1]})")
    print(f"error of the path: {path:.3f} of that without (claim: {CLAIMS[2]})")
    print(f"error of the force: {force:.3f} of that without (claim: {CLAIMS[2]})")
    axes[0].set_ylabel("error of tool.z [mm]")
    axes[1].set(ylabel="force [N]", xlabel="time [s]")
    axes[0].legend()
    figure.savefig(folder / "polish_unknown_part.png", dpi=120)
    plt.close(figure)
    return off, angle, path, force


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
