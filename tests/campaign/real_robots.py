"""Robots as vendors wrote them, from `drake-dae new` to a finished run: python real_robots.py

It takes those of the packages example-robot-data, pybullet_data and robosuite that are installed.
pybullet builds for minutes, and robosuite needs much; their files alone are enough:

    pip download --no-deps --no-binary pybullet pybullet && tar xzf pybullet-*.tar.gz
    pip download --no-deps robosuite && unzip robosuite-*.whl 'robosuite/models/assets/*'
    PYTHONPATH=<folder of pybullet_data>:<folder of robosuite> python tests/campaign/real_robots.py
"""

import argparse
import contextlib
import multiprocessing
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

SURFACES = ("plane", "cylinder", "sphere")

ROBOTS = {
    "example-robot-data": """
        a1_description/urdf/a1.urdf alex_description/urdf/alex_nub_hands.urdf
        alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf
        allegro_hand_description/urdf/allegro_right_hand.urdf
        anymal_b_simple_description/robots/anymal-kinova.urdf
        anymal_c_simple_description/urdf/anymal.urdf asr_twodof_description/urdf/TwoDofs.urdf
        b1_description/urdf/b1-z1.urdf baxter_description/urdf/baxter.urdf
        bolt_description/robots/bolt.urdf borinot_description/urdf/borinot_flying_arm_2.urdf
        cassie_description/robots/cassie.sdf cassie_description/robots/cassie_v2.sdf
        centauro_description/urdf/centauro.urdf
        double_pendulum_description/urdf/double_pendulum.urdf
        double_pendulum_description/urdf/double_pendulum_continuous.urdf
        double_pendulum_description/urdf/double_pendulum_simple.urdf
        finger_edu_description/robots/finger_edu.urdf g1_description/urdf/g1_29dof_rev_1_0.urdf
        g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf go1_description/urdf/go1.urdf
        go2_description/urdf/go2.urdf hector_description/robots/quadrotor_base.urdf
        hextilt_description/urdf/hextilt_flying_arm_5.urdf human_description/robots/human.urdf
        hyq_description/robots/hyq_no_sensors.urdf icub_description/robots/icub.urdf
        iris_description/robots/iris.urdf laikago_description/urdf/laikago.urdf
        pr2_description/urdf/pr2.urdf quadruped_description/urdf/quadruped.urdf
        romeo_description/urdf/romeo.urdf simple_humanoid_description/urdf/simple_humanoid.urdf
        so_arm_description/urdf/so101.urdf solo_description/robots/solo.urdf
        solo_description/robots/solo12.urdf talos_data/robots/talos_full_v2.urdf
        talos_data/robots/talos_left_arm.urdf tiago_description/robots/tiago_dual.urdf
        tiago_pro_description/robots/tiago_pro.urdf ur_description/urdf/ur3_robot.urdf
        ur_description/urdf/ur3_gripper.urdf ur_description/urdf/ur5_gripper.urdf
        ur_description/urdf/ur10_joint_limited_robot.urdf
    """,
    "robosuite": """
        baxter/robot.xml gr1/robot.xml iiwa/robot.xml jaco/robot.xml kinova3/robot.xml
        panda/robot.xml sawyer/robot.xml spot/robot.xml spot_arm/robot.xml tiago/robot.xml
        ur5e/robot.xml xarm7/robot.xml
    """,
    "pybullet_data": """
        TwoJointRobot_w_fixedJoints.urdf TwoJointRobot_wo_fixedJoints.urdf a1/a1.urdf
        aliengo/aliengo.urdf biped/biped2d_pybullet.urdf cartpole.urdf franka_panda/panda.urdf
        gripper/wsg50_one_motor_gripper_left_finger.urdf humanoid/humanoid.urdf husky/husky.urdf
        kuka_iiwa/model.urdf kuka_iiwa/model_free_base.urdf laikago/laikago_toes.urdf
        mini_cheetah/mini_cheetah.urdf pendulum5.urdf pr2_gripper.urdf quadruped/minitaur.urdf
        quadruped/spirit40.urdf quadruped/vision60.urdf r2d2.urdf racecar/racecar.urdf
        xarm/xarm6_robot.urdf xarm/xarm6_with_gripper.urdf mjcf/ant.xml mjcf/half_cheetah.xml
        mjcf/hopper.xml mjcf/humanoid.xml mjcf/inverted_double_pendulum.xml mjcf/pusher.xml
        mjcf/reacher.xml mjcf/striker.xml mjcf/swimmer.xml mjcf/thrower.xml mjcf/walker2d.xml
    """,
}
"""Package -> the files of robots, none of which any test names."""

_INSIDE = {"example-robot-data": "robots", "robosuite": "models/assets/robots", "pybullet_data": ""}


def installed() -> Iterator[tuple[str, Path]]:
    """Name and file of each robot that is there."""
    for package, files in ROBOTS.items():
        spec = find_spec(package) if package.isidentifier() else None
        places = [Path(place) for place in (spec.submodule_search_locations or [] if spec else [])]
        places += [Path(place, "cmeel.prefix/share", package) for place in sys.path]
        folder = next((place for place in places if place.is_dir()), None)
        if folder is None:
            print(f"{package} is not installed: {len(files.split())} robots less", file=sys.stderr)
            continue
        for file in files.split():
            yield f"{package}/{file}", folder / _INSIDE[package] / file


def _attempt(file: Path, surface: str, settings: list[str], out: Path) -> None:
    """Runs both commands in this process, which then ends; `out` takes what they print."""
    from drake_dae.cli import main

    with out.open("w") as text, contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        os.dup2(text.fileno(), 1)
        os.dup2(text.fileno(), 2)
        scenario = out.with_suffix(".yaml")
        code = main(["new", str(file), "--surface", surface, "--out", str(scenario)])
        if code == 0:
            sets = [part for setting in settings for part in ("--set", setting)]
            quiet = ["--set", "write.plots=false", "--set", "write.animation=false"]
            code = main(["simulate", str(scenario), *quiet, *sets, "--out", f"{out}.run"])
    os._exit(int(code))


def outcome(file: Path, surface: str, settings: list[str], limit: float) -> tuple[str, str]:
    """How a robot ends on a surface, "ran", "refused", "raw" or "hang", and the last sentence."""
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "printed")
        process = context.Process(target=_attempt, args=(file, surface, settings, out))
        process.start()
        process.join(limit)
        if process.is_alive():
            process.kill()
            process.join()
            return "hang", f"no end within {limit:g} s"
        text = out.read_text(errors="replace")
        verdict = re.search(r"^(GOOD|BAD|UNDECIDED).*", text, re.MULTILINE)
        if process.exitcode == 0:
            return "ran", verdict[0] if verdict else text[-200:]
        return ("refused" if "Traceback" not in text else "raw"), " ".join(text.split())[-600:]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--only", default="", help="robots whose name contains this")
    parser.add_argument("--surfaces", nargs="+", choices=SURFACES, default=SURFACES)
    parser.add_argument("--set", dest="settings", action="append", default=[])
    parser.add_argument("--limit", type=float, default=300.0, help="s for one run")
    given = parser.parse_args()
    import drake_dae.scenario.new  # noqa: F401  Once, before the forks.

    counts, raw = {surface: 0 for surface in given.surfaces}, 0
    robots = whole = 0
    for name, file in installed():
        if given.only not in name:
            continue
        robots += 1
        ends = []
        for surface in given.surfaces:
            began = time.monotonic()
            end, text = outcome(file, surface, given.settings, given.limit)
            ends.append(end)
            raw += end in ("raw", "hang")
            counts[surface] += end == "ran"
            print(
                f"{name:62} {surface:9}{end:8}{time.monotonic() - began:5.0f} s  {text}", flush=True
            )
        whole += all(end == "ran" for end in ends)
    print(f"\n{robots} robots; finished: {counts}, on all surfaces {whole}; raw or hanging: {raw}")
    return int(raw > 0)


if __name__ == "__main__":
    sys.exit(main())
