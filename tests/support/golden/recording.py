"""Makes what the records keep: `PYTHONPATH=tests/support python -m golden.recording [NAME ...]`
writes them anew."""

import io
import json
import sys
import warnings
from importlib.metadata import version

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig

from drake_dae import build_scenario, contact_gains, load_scenario, rollout
from drake_dae.cli import main
from drake_dae.running import start_values
from drake_dae.scenario.shipped import find_scenario
from golden.cases import CASES, FIXTURE, STEPS, Case

SIGNALS = ("state", "constraint_force", "control", "controlled_output")


def built(case: Case):
    return build_scenario(load_scenario(find_scenario(case.scenario), case.all_settings))


def config_of(case: Case) -> SimulatorConfig:
    return SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=case.step, use_error_control=False
    )


def times_of(case: Case) -> np.ndarray:
    return case.duration * (np.arange(STEPS + 1) / STEPS)


def signals_at(loop, context) -> np.ndarray:
    ports = [loop.diagram.GetOutputPort(name) for name in SIGNALS]
    return np.concatenate([port.Eval(context) for port in ports])


def run_of(case: Case, loop, context) -> np.ndarray:
    """All signals at every second moment, by Drake's Simulator."""
    simulator = Simulator(loop.diagram, context)
    ApplySimulatorConfig(config_of(case), simulator)
    simulator.Initialize()
    rows = [signals_at(loop, context)]
    for number, time in enumerate(times_of(case)[1:].tolist(), start=1):
        simulator.AdvanceTo(time)
        if number % 2 == 0:
            rows.append(signals_at(loop, context))
    return np.array(rows)


def rollout_of(case: Case, loop, context, compiled: bool) -> np.ndarray:
    """The same by a rollout."""
    starts, parameters = start_values(loop, context)
    times, config = times_of(case), config_of(case)
    (found,) = rollout(loop, starts, parameters, times, config=config, compiled=compiled)
    if found.failure is not None:
        raise found.failure
    return np.hstack([found.record[name] for name in SIGNALS])[::2]


def values_at(loop, states: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """A, B, alpha, beta, the law and residual at 20 consistent states; of matrices a product."""
    law = loop.controller.law
    structure, system = law.structure, law.structure.system
    if states is None:
        random = np.random.default_rng(0)
        guesses = structure.states[random.integers(len(structure.states), size=20)]
        guesses = guesses + 0.02 * random.normal(size=guesses.shape) * structure.scale
        states = np.array([structure.manifold.project(x) for x in guesses])
    part = structure.elimination
    expressions = {
        "A": part.constraint_matrix,
        "B": structure.control_matrix,
        "alpha": part.alpha,
        "beta": part.beta,
        "drift": structure.drift,
    }
    functions = {name: structure.trace(name, value, False) for name, value in expressions.items()}
    parameters = system.parameter_values
    random = np.random.default_rng(1)
    references = random.normal(size=(len(states), structure.layout.reference_size))
    found = {name: [] for name in (*functions, "control", "residual")}
    force = random.normal(size=system.num_constraints)
    for x, r in zip(states, references, strict=True):
        for name, function in functions.items():
            value = function(x, parameters)[0].reshape(expressions[name].shape)
            found[name].append(value @ np.cos(np.arange(value.shape[1])))
        takes = "measured_force" in law.function.input_names
        measured = {"measured_force": force} if takes else {}
        found["control"].append(np.asarray(law.control(x, r, **measured)))
        found["residual"].append(structure.manifold.residual(x + 0.01 * structure.scale))
    return {"states": states, **{name: np.array(rows) for name, rows in found.items()}}


def gains_found() -> dict[str, list[float]]:
    """Computed gains: six of `contact_gains`, six of scenarios."""
    found = {}
    contacts = [(1e5, 0.03, 1e-3), (1e4, 0.03, 1e-3), (1e6, 0.03, 1e-3), (1e5, 0.5, 1e-3)]
    contacts += [(1e4, 0.1, 4e-3), (3e5, 0.05, 5e-4)]
    for stiffness, mobility, period in contacts:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            gains = contact_gains(stiffness, mobility, period)
        key = f"{stiffness:g} N/m, {mobility:g} 1/kg, {period:g} s"
        found[key] = [float(value) for value in vars(gains).values()]
    settings = {
        "point": (),
        "softer": ("plant.stiffness=2e4",),
        "late": ("sampling.delay=0.002",),
        "encoders": ("sensors.encoders={resolution: 1.0e-5}",),
        "differences": ("sensors.encoders={resolution: 1.0e-5, velocity_bandwidth: 300}",),
        "slow": ("plant.time_step=0.002", "sampling={period: 0.002, delay: 0.002}"),
    }
    for name, changed in settings.items():
        chosen = load_scenario(find_scenario("wall_point_contact"), changed)
        law = build_scenario(chosen)[0].controller.law
        found[name] = law.gains.matrix[law.gains.matrix != 0.0].tolist()
    return found


def analysis_of(name: str) -> dict:
    """What `analyze --json` prints of a shipped scenario: its part `analysis`."""
    output, stdout = io.StringIO(), sys.stdout
    sys.stdout = output
    try:
        main(["analyze", name, "--json"])
    finally:
        sys.stdout = stdout
    return _without_states(json.loads(output.getvalue())["analysis"])


def _without_states(value):
    """Without the states where a smallest value was found: others are as good."""
    if isinstance(value, dict):
        return {key: _without_states(v) for key, v in value.items() if key not in ("state", "time")}
    return [_without_states(part) for part in value] if isinstance(value, list) else value


def record(names: list[str]) -> None:
    kept = dict(np.load(FIXTURE)) if FIXTURE.exists() else {}
    kept["drake"] = np.array(version("drake"))
    for name, case in CASES.items():
        if names and name not in names:
            continue
        print(name, flush=True)
        kept[f"run/{name}"] = run_of(case, *built(case))
        if case.scenario == name:
            for key, value in values_at(built(case)[0]).items():
                kept[f"at/{name}/{key}"] = value
            kept[f"analysis/{name}"] = np.array(json.dumps(analysis_of(name)))
        np.savez_compressed(FIXTURE, **kept)
    if not names or "gains" in names:
        kept["gains"] = np.array(json.dumps(gains_found()))
    np.savez_compressed(FIXTURE, **kept)
    print(f"{FIXTURE.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    record(sys.argv[1:])
