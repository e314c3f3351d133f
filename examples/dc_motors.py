"""The two-link arm driven by DC motors (74)-(83), once with a wrong model.

Voltages steer; position outputs have degree 3, the contact force has degree 1. The controller
believes link 2 to be 10 % heavier than it is. Feeding back the measured force, as (81) allows,
removes the force error that the wrong model leaves at rest.

Claims: with the right model the errors are the solutions of (82), (83) to 1e-9; with the wrong one
the force error at rest falls below 1e-4 of what it is without measurement.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd

MOTORS = dd.DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)


def run(mass_factor: float, measured_force: bool) -> tuple[dd.Record, np.ndarray]:
    """The record of a move to another height, and the predicted errors."""
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(dd.shipped_model("two_link_arm.urdf")))
    multibody.Finalize()
    model = dd.RobotModel.from_multibody(
        multibody,
        constraints=[dd.PointOnSurface("tool", dd.Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")],
        outputs=[dd.PointCoordinates("tool", "z")],
        nominal_positions=[1.2, -1.6],
        actuation=[MOTORS],
    )
    law = dd.TrackingLaw(model.dae, dd.poles(-8.0), measured_force=measured_force)
    move = dd.PointToPointReference(0.3, 0.6, start_time=0.5, end_time=2.0, order=3)
    # Behind motors the force is a function of the state: it may be connected without a sensor.
    loop = dd.make_closed_loop(
        dd.RobotPlant(model, structure=law.structure), law, [move, dd.ConstantReference(20.0)]
    )
    context = loop.diagram.CreateDefaultContext()
    believed = loop.controller.GetMyMutableContextFromRoot(context)
    loop.controller.set_parameter(
        believed, "link2.mass", mass_factor * loop.controller.get_parameter(believed, "link2.mass")
    )
    q = model.configuration([0.32], guess=[1.2, -1.6])
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), model.rest_state(q, forces=[15.0])
    )
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-3, use_error_control=False
    )
    dd.simulate(loop.diagram, context, 5.0, config)
    record = loop.record(context)
    return record, loop.predicted_error(record)


def main(folder: Path) -> tuple[float, float]:
    """Returns the distance from the prediction, and the ratio of the force errors at rest."""
    record, predicted = run(1.0, measured_force=False)
    off = float(np.max(np.abs(record["tracking_error"] - predicted)))
    print(f"right model: errors off (82), (83) by at most {off:.1e} (claim: 1e-9)")
    figure, axis = plt.subplots(layout="constrained")
    axis.plot(record.time, record["tracking_error"][:, 1], label="right model")
    left = []
    for measured in (False, True):
        record, _ = run(1.1, measured)
        left.append(abs(record["tracking_error"][-1, 1]))
        name = "measured force" if measured else "model's force"
        axis.plot(record.time, record["tracking_error"][:, 1], label=f"wrong model, {name}")
        print(f"wrong model, {name}: force error at rest {left[-1]:.2e} N")
    ratio = float(left[1] / left[0])
    print(f"ratio {ratio:.1e} (claim: 1e-4)")
    axis.set(xlabel="time [s]", ylabel="force error [N]")
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(folder / "dc_motors.png", dpi=120)
    plt.close(figure)
    return off, ratio


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
