"""From one contact to another with the least effort: the DAE beside Drake and crocoddyl.

The two-link arm presses on the wall x = 1.2 m at the height 0, and has to press on it at 0.6 m one
second later, from rest to rest, with the least integral of |u|^2. Path and contact force, within 5
and 50 N, are free. `task.py` has the task and judges the plans by an integrator of SciPy on Drake's
MultibodyPlant, which no method has seen; `collocation.py` has the method for DAEs.

Claims: the plan of the DAE is within 1e-6 m of the wall also between the points, its torques bring
the arm on the wall within 1e-5 m of the second contact, and its contact force is within 0.1 N of
the limits.

    python examples/between_contacts [FOLDER]

prints the table below, and writes it to between_contacts.md in the folder. crocoddyl is
left out where it is not installed.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import collocation
import drake_plans
import numpy as np
from task import Judged, Plan, ends, judge, robot_model

import drake_dae as dd

HEAD = (
    "| method | cost, (N m)^2 s | time, s | off the wall between points, m "
    "| off it, integrated without the wall, m | misses the end, integrated on the wall, m "
    "| contact force, N |\n| :-- | --: | --: | --: | --: | --: | --: |"
)

INSTALL = 'pip install crocoddyl==3.2.1 "pin<4.1"; newer pin makes it crash'

Method = Callable[[dd.RobotModel, np.ndarray, np.ndarray], Plan]


def main(folder: Path, with_peers: bool = True) -> Judged:
    """Returns what the plan of the DAE is worth."""
    methods: list[Method] = [collocation.plan]
    if with_peers:
        methods += [drake_plans.with_force_eliminated, drake_plans.with_force_as_input]
        try:
            import crocoddyl_plan

            methods.append(crocoddyl_plan.plan)
        except ImportError as error:
            print(f"crocoddyl is left out ({error}): {INSTALL}")
    model, found = robot_model(), list[Judged]()
    first, last = ends(model)
    lines = [HEAD]
    print(HEAD, flush=True)
    for method in methods:
        plan = method(model, first, last)
        own = judge(plan, first)
        found.append(own)
        lines.append(row(plan, own))
        print(lines[-1], flush=True)
    (folder / "between_contacts.md").write_text("\n".join([*lines, ""]), encoding="utf-8")
    return found[0]


def row(plan: Plan, own: Judged) -> str:
    """A line of the table."""
    name = plan.name if plan.converged else f"{plan.name} (did not converge)"
    distances = (f"{each:.1e}" for each in (own.between, own.drifts, own.misses))
    force = f"{own.least:.2f} to {own.most:.2f}"
    return f"| {name} | {own.cost:.1f} | {plan.seconds:.2f} | {' | '.join(distances)} | {force} |"


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the table goes into a folder that is there")
    main(folder)
