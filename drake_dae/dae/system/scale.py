"""Random states around a state."""

import numpy as np

from drake_dae.arrays import FloatArray


def spread_about(state: FloatArray, scale: FloatArray) -> FloatArray:
    """Returns the default standard deviation of random states around a state: 0.1 of the scale.

    It is a hundredth of a value above 10 scales, and a tenth of one below 1e-3 scales that is not
    round-off of a scale.
    """
    size = np.abs(state) / scale
    small = (size < 1e-3) & (size > 1e-12 * max(1.0, size.max()))
    return scale * np.where(size > 10.0, 0.01 * size, np.where(small, 0.1 * size, 0.1))
