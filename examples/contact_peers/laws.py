"""The laws that the table compares, in its order."""

from contact_peers.joint_laws import InverseDynamics, JointStiffness
from contact_peers.task_laws import (
    Admittance,
    Hybrid,
    HybridWithObserver,
    Impedance,
    ImpedanceWithObserver,
    LeastSquares,
)

LAWS = {
    "InverseDynamicsController + J^T lambda": InverseDynamics,
    "JointStiffnessController + J^T lambda": JointStiffness,
    "hybrid position/force, PI": Hybrid,
    "impedance + force ahead": Impedance,
    "admittance": Admittance,
    "least squares (as TSID)": LeastSquares,
    "hybrid, PI + momentum observer": HybridWithObserver,
    "impedance + momentum observer": ImpedanceWithObserver,
}
"""Name -> the law, with its limits of gains."""
