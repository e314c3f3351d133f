"""Places of surfaces that an observer finds, beside the true ones."""

import numpy as np

from drake_dae import ClosedLoop, Record
from drake_dae.scenario.scenario import Scenario


def found_off(
    chosen: Scenario, loop: ClosedLoop, record: Record, rows: np.ndarray, at: int
) -> np.ndarray:
    """The distances of the estimated surface from the true one along the way of a tool, m.

    The estimate is that of the row `at`, and the way that of the rows `rows`.
    """
    dae = loop.controller.law.system
    distance = dae.trace("distance", {"value": dae.k})
    own, sought = chosen.plant.parameters, chosen.estimator.parameters
    places = {name: np.array(own[name]) for name in sought if name in own}
    truth = dae.with_values(places).parameter_values
    names = [signal.name.partition("[")[0] for signal in record.signals["identified"].signals]
    found = {n: record["identified"][at][[m == n for m in names]] for n in places}
    values = dae.with_values(found).parameter_values
    return np.array(
        [
            distance(x, values)[0].item() - distance(x, truth)[0].item()
            for x in record["state"][rows]
        ]
    )
