"""A system without its redundant constraints has the same motion."""

import numpy as np
import pytest
from problems import redundant, system_of
from problems.made_up import TABLE, plate

from drake_dae import DaePlant, drop_constraints, find_structure
from drake_dae.errors import AssumptionError, ModelError


@pytest.mark.parametrize("names", [None, ["leg3"], ["leg0"]])
def test_a_table_with_four_legs_stands_on_three(names):
    """Whichever leg goes, the sum of forces and torques is that of the load, by NumPy alone."""
    with pytest.raises(AssumptionError):
        find_structure(plate(TABLE))
    system = drop_constraints(plate(TABLE), names)
    gone = (names or ["leg3"])[0]
    stay = [i for i in range(4) if f"leg{i}" != gone]
    assert [s.name for s in system.constraint_output_signals] == [f"leg{i}" for i in stay]
    plant = DaePlant(system)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, [0.0])
    force = plant.GetOutputPort("constraint_force").Eval(context)
    jacobian = np.array([[1.0, *TABLE[i]] for i in stay])
    np.testing.assert_allclose(jacobian.T @ force, [9.81 * 4.0, -0.3, 0.2], rtol=1e-12)
    rates = plant.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(rates, 0.0, atol=1e-12)


def test_what_cannot_go_is_refused():
    with pytest.raises(ModelError, match=r"'leg4'.*'leg"):
        drop_constraints(plate(TABLE), ["leg4"])
    with pytest.raises(ModelError, match="'leg0', 'leg1'"):
        drop_constraints(plate(TABLE), ["leg0", "leg1"])
    # v_2 pushes z'' beside x''.
    with pytest.raises(ModelError, match="'y1'"):
        drop_constraints(redundant(lambda x: [x[0], x[0]]))
    with pytest.raises(ModelError, match="'y1'"):
        drop_constraints(
            system_of(
                2,
                f=lambda x: [0, 0],
                g=lambda x: [[1, 1], [0, 0]],
                h=lambda x: [0, 1],
                k=lambda x: [x[0], 2 * x[0]],
                l=lambda x: [0],
                m=lambda x: [[0, 1]],
            )
        )
