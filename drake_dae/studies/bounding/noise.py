"""What the noise of its sensors does to a scenario's outputs, predicted without a run."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.state_feedback import ENCODER_NOISE
from drake_dae.errors import DrakeDaeError
from drake_dae.running.rollout.problems import start_values
from drake_dae.running.rollout.spread.noise import NoiseSpread, spread_with_rounding
from drake_dae.running.rollout.spread.rounding import Rounding
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import for_rollout
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario

_LOOKED, _LONGEST = 12, 4.0
"""At how many times of a motion slopes are computed; the spread is told of the second half, which
ends after at most 4 s."""

_OF_TASKS = (
    "a task changes its law when contacts close and open, at times that noise moves. Runs with "
    "several seeds show it, as by `drake-dae sweep` with `--vary encoders.seed=1..20:20`"
)

_UNITS = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}


@dataclass(frozen=True, eq=False)
class NoiseOutlook:
    """The predicted standard deviations of a scenario's outputs by the noise of its sensors.

    Attributes:
        outputs: Name of an output -> unit and deviation.
        roughness: The rms change of the controls from one sample to the next, over all drives, in
            their unit.
        unit: That unit; empty if drives have several.
        reason: Why there is no prediction; empty if there is one.
    """

    outputs: dict[str, tuple[str, float]]
    roughness: float = 0.0
    unit: str = ""
    reason: str = ""

    def __str__(self) -> str:
        if self.reason:
            return f"no prediction of what noise does: {self.reason}"
        parts = []
        for name, (unit, deviation) in self.outputs.items():
            shown, factor = _UNITS.get(unit, (unit, 1.0))
            parts.append(f"{name} {factor * deviation:.2g} {shown}".rstrip())
        rough = f"{self.roughness:.2g} {self.unit}".rstrip()
        return (
            "noise of the sensors spreads the outputs, as standard deviations to first order: "
            f"{', '.join(parts)}; the controls change by {rough} from sample to sample"
        )

    def to_dict(self) -> dict[str, Any]:
        """The outlook as plain data, in SI units."""
        if self.reason:
            return {"reason": self.reason}
        deviations = {name: deviation for name, (_, deviation) in self.outputs.items()}
        return {"deviations": deviations, "roughness": self.roughness}


def noise_outlook(scenario: Scenario) -> NoiseOutlook | None:
    """Predicts the deviations of outputs and controls by the noise of encoders and force sensor.

    It is `noise_spread` of the scenario's loop, on the plant that rollouts have, from its start; of
    the resolution of encoders by runs of the linearized loop with other zeros (`RoundedRuns`).

    Args:
        scenario: The scenario, as `load_scenario` returns it.

    Returns:
        The outlook, or why there is none, as for a task; None for a scenario without noise.
    """
    encoders = scenario.encoders
    if encoders is not None and np.any(encoders.resolution):
        # What rounds has no slope.
        noise = encoders.position_deviation
        encoders = replace(encoders, resolution=0.0, position_noise=noise)
    deviations = [
        *([] if encoders is None else [encoders.position_noise, encoders.velocity_noise]),
        getattr(scenario.force_feedback, "noise_deviation", 0.0),
    ]
    if not any(np.any(np.asarray(each)) for each in deviations):
        return None
    if scenario.task is not None:
        return NoiseOutlook({}, reason=_OF_TASKS)
    until = min(scenario.duration, _LONGEST)
    times = scenario.integrator.start_time + until * np.arange(1, _LOOKED + 1) / _LOOKED
    try:
        completed, loop = build_completed(replace(for_rollout(scenario)[0], encoders=encoders))
        start, parameters = start_values(loop, start_scenario(completed.scenario, loop))
        rounding = None if encoders is scenario.encoders else _rounding(scenario, loop)
        config = scenario.integrator
        whole = spread_with_rounding(loop, start, parameters, times, config, rounding)
    except DrakeDaeError as error:
        return NoiseOutlook({}, reason=str(error))
    late = slice(_LOOKED // 2, None)
    parts = (
        {name: values[late] for name, values in each.items()}
        for each in (whole.deviations, whole.changes)
    )
    spread = NoiseSpread(whole.times[late], *parts)
    signals = loop.signals["controlled_output"]
    rms = spread.rms("controlled_output").tolist()
    outputs = {s.name: (s.unit, each) for s, each in zip(signals, rms, strict=True)}
    units = {signal.unit for signal in loop.signals["control"]}
    unit = units.pop() if len(units) == 1 else ""
    return NoiseOutlook(outputs, spread.roughness("control"), unit)


def _rounding(scenario: Scenario, loop: ClosedLoop) -> Rounding:
    """How the encoders of a scenario round the positions of its robot."""
    encoders, model = scenario.encoders, loop.plant.model
    assert encoders is not None
    assert model is not None
    count = model.links.q.numel()
    steps, noise = (
        np.broadcast_to(np.asarray(each, dtype=float), count)
        for each in (encoders.resolution, encoders.position_noise)
    )
    return Rounding(ENCODER_NOISE, "state", steps, noise)
