"""A warning for laws with unstable zero dynamics.                                        (35)"""

import warnings

from numpy.typing import ArrayLike

from drake_dae.dae import TrackingLaw, Verdict, ZeroDynamics
from drake_dae.errors import NonMinimumPhaseWarning


def warn_of_zero_dynamics(law: TrackingLaw, outputs: ArrayLike | None) -> None:
    """Warns if the zero dynamics (35) of a law are unstable.

    Args:
        law: The law.
        outputs: z at which they are judged, shape (p,); None for those at the nominal state.
    """
    if not law.structure.zero_dynamics_dimension:
        return
    dynamics = ZeroDynamics(law.system, structure=law.structure)
    stability = dynamics.stability(law.structure.states[0], outputs=outputs)
    if stability.verdict is Verdict.UNSTABLE:
        warnings.warn(
            f"{law.system.name}: {stability.reason}. The outputs follow the reference while other "
            "states, or the control, grow without bound; choose other outputs",
            NonMinimumPhaseWarning,
            stacklevel=3,
        )
