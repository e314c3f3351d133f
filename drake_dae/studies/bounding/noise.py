"""What the noise of its sensors does to a scenario's outputs, to first order or by runs."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.state_feedback import ENCODER_NOISE
from drake_dae.errors import DrakeDaeError
from drake_dae.running.rollout.problems import start_values
from drake_dae.running.rollout.program import program_of
from drake_dae.running.rollout.spread.noise import NoiseSpread, check_smooth, spread_with_rounding
from drake_dae.running.rollout.spread.rounding import Rounding
from drake_dae.running.rollout.spread.runs import NoisyRuns, noisy_runs, off_proportion
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import for_rollout
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario

_LOOKED, _LONGEST = 12, 4.0
"""At how many times of a motion slopes are computed; the spread is told of the second half, which
ends after at most 4 s."""

_OFF, _RUNS = 0.2, 64
"""A prediction to first order is for responses to noise that differ by less than 20 % from linear
ones; for others there are so many runs."""

_OUTPUTS = "controlled_output"

_OF_TASKS = (
    "a task changes its law when contacts close and open, at times that noise moves. Runs with "
    "several seeds show it, as by `drake-dae sweep` with `--vary encoders.seed=1..20:20`"
)

_UNITS = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}


@dataclass(frozen=True, eq=False)
class NoiseOutlook:
    """The standard deviations of a scenario's outputs by the noise of its sensors.

    Attributes:
        outputs: Name of an output -> unit and deviation.
        roughness: The rms change of the controls from one sample to the next, over all drives, in
            their unit.
        unit: That unit; empty if drives have several.
        reason: Why there is no prediction; empty if there is one.
        off: How far the response of the outputs to noise is from a linear one, as a share of it,
            the largest of all outputs; see `off_proportion`.
        shifts: Name of an output -> the rms distance of the mean of runs with noise from the run
            without; empty if the prediction is one to first order, without such runs.
    """

    outputs: dict[str, tuple[str, float]]
    roughness: float = 0.0
    unit: str = ""
    reason: str = ""
    off: float = 0.0
    shifts: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        if self.reason:
            return f"no prediction of what noise does: {self.reason}"
        rough = f"{self.roughness:.2g} {self.unit}".rstrip()
        spread = _listed(self.outputs)
        if not self.shifts:
            return (
                "noise of the sensors spreads the outputs, as standard deviations to first order: "
                f"{spread}; the controls change by {rough} from sample to sample"
            )
        shifted = _listed({n: (self.outputs[n][0], shift) for n, shift in self.shifts.items()})
        return (
            "noise of the sensors is too large for a prediction to first order: the response to "
            f"all of it differs by {100.0 * self.off:.0f} % from ten times the response to a tenth "
            f"of it. In {_RUNS} runs with noise the outputs have the standard deviations {spread}; "
            f"noise moves their means by {shifted}; the controls change by {rough} from sample to "
            "sample"
        )

    def to_dict(self) -> dict[str, Any]:
        """The outlook as plain data, in SI units."""
        if self.reason:
            return {"reason": self.reason}
        deviations = {name: deviation for name, (_, deviation) in self.outputs.items()}
        found = {"deviations": deviations, "roughness": self.roughness, "off": self.off}
        return found | ({"shifts": self.shifts} if self.shifts else {})


def _listed(values: dict[str, tuple[str, float]]) -> str:
    """Values with their names and units, as text."""
    parts = []
    for name, (unit, value) in values.items():
        shown, factor = _UNITS.get(unit, (unit, 1.0))
        parts.append(f"{name} {factor * value:.2g} {shown}".rstrip())
    return ", ".join(parts)


def noise_outlook(scenario: Scenario) -> NoiseOutlook | None:
    """Predicts the deviations of outputs and controls by the noise of encoders and force sensor.

    It is `noise_spread` of the scenario's loop, on the plant that rollouts have, from its start; of
    the resolution of encoders by runs of the linearized loop (`RoundedRuns`). That is a prediction
    to first order: it holds if a tenth of the noise does a tenth of what the noise does. Where
    friction holds the tool for a while and lets it go, as at a start, a rest or a reversal, noise
    decides when and in which direction, and the response to small noise is another than that to
    large noise. So the loop runs with a tenth of the noise and with all of it. Where the responses
    differ by more than 20 %, runs with other random numbers, and with other zeros of encoders that
    round, take the place of the prediction.

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
    try:
        return _outlook(scenario, replace(for_rollout(scenario)[0], encoders=encoders))
    except DrakeDaeError as error:
        return NoiseOutlook({}, reason=str(error))


def _outlook(scenario: Scenario, unrounded: Scenario) -> NoiseOutlook:
    """The outlook of a scenario, and the same with noise in place of what its encoders round."""
    config, until = scenario.integrator, min(scenario.duration, _LONGEST)
    times = config.start_time + until * np.arange(1, _LOOKED + 1) / _LOOKED
    late = float(times[_LOOKED // 2 - 1]), float(times[-1])
    completed, loop = build_completed(unrounded)
    check_smooth(loop, program_of(loop))
    start, parameters = start_values(loop, start_scenario(completed.scenario, loop))
    shares, quiet = off_proportion(loop, start, parameters, late, config, _OUTPUTS)
    signals, off, shifts = loop.signals[_OUTPUTS], float(np.max(shares)), {}
    if off > _OFF:
        runs = _runs(replace(completed.scenario, encoders=scenario.encoders), late)
        spread = runs.spread
        moved = np.sqrt(np.mean(np.square(runs.means[_OUTPUTS] - quiet), axis=0)).tolist()
        shifts = {signal.name: each for signal, each in zip(signals, moved, strict=True)}
    else:
        rounding = None if unrounded.encoders is scenario.encoders else _rounding(scenario, loop)
        whole = spread_with_rounding(loop, start, parameters, times, config, rounding)
        parts = (
            {name: values[_LOOKED // 2 :] for name, values in each.items()}
            for each in (whole.deviations, whole.changes)
        )
        spread = NoiseSpread(whole.times[_LOOKED // 2 :], *parts)
    rms = spread.rms(_OUTPUTS).tolist()
    outputs = {s.name: (s.unit, each) for s, each in zip(signals, rms, strict=True)}
    units = {signal.unit for signal in loop.signals["control"]}
    unit = units.pop() if len(units) == 1 else ""
    return NoiseOutlook(outputs, spread.roughness("control"), unit, "", off, shifts)


def _runs(scenario: Scenario, times: tuple[float, float]) -> NoisyRuns:
    """Runs of a scenario with noise, in each of which its encoders have other zeros."""
    loop = build_completed(scenario)[1]
    context, rng = start_scenario(scenario, loop), np.random.default_rng(0)
    cases, sensor = [], None if loop.encoders is None else loop.encoders.sensor
    for _ in range(_RUNS):
        if sensor is not None and np.any(sensor.encoders.resolution):
            own = sensor.GetMyMutableContextFromRoot(context)
            part = rng.uniform(-0.5, 0.5, own.get_numeric_parameter(0).size())
            sensor.set_zeros(own, np.asarray(sensor.encoders.resolution) * part)
        cases.append(start_values(loop, context))
    starts, parameters = (np.array(each) for each in zip(*cases, strict=True))
    names = _OUTPUTS, "control"
    return noisy_runs(loop, starts, parameters, times, scenario.integrator, names)


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
