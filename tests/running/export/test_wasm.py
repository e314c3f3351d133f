"""Controller, plant and loop as WebAssembly, run by Node, against Drake's Simulator."""

import json
import shutil
import subprocess
from importlib.util import find_spec

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from runs import run, scenario

from drake_dae import build_scenario
from drake_dae.cli import main
from drake_dae.errors import MachineCodeError
from drake_dae.running import export_wasm
from drake_dae.trace import compiler

needs_zig = pytest.mark.skipif(find_spec("ziglang") is None, reason="there is no ziglang")
CONFIG = SimulatorConfig(
    integration_scheme="runge_kutta3", use_error_control=False, max_step_size=0.001
)
SETTINGS = ("sampling={period: 0.001}", "estimator={rate: 20.0}", "saturation=true")
SETTINGS += ("sensors.force={sample_period: 0.001}",)

SCRIPT = """
import { readFileSync } from "node:fs";
import { load } from "./arm.mjs";
const module = new WebAssembly.Module(readFileSync("arm.wasm"));
const { create, parts } = await load();
const said = (act) => { try { act(); return ""; } catch (error) { return error.message; } };
const loop = create("loop"), plant = create("plant"), controller = create("controller");
const rows = [];
let off = 0;
for (let k = 0; k < 300; k++) {
  const time = 0.001 * k;
  loop.advance(time);
  plant.advance(time);
  for (const key in controller.inputs) controller.inputs[key] = plant.outputs[key];
  if (controller.step(time) !== "running") throw new Error(controller.fault);
  plant.inputs.control = controller.outputs.control;
  rows.push(Array.from(loop.outputs.state).concat(Array.from(loop.outputs.disturbance)));
  plant.outputs.state.forEach((x, i) => (off = Math.max(off, Math.abs(x - loop.state[i]))));
}
const key = Object.keys(loop.parameters)[0], before = loop.outputs.constraint_force[0];
loop.parameters[key] *= 1.1;
loop.show();
const heavier = loop.outputs.constraint_force[0] - before;
loop.reset();
controller.patience = 0;
controller.inputs.state = controller.inputs.state.map(() => NaN);
plant.inputs.control[0] = NaN;
console.log(JSON.stringify({
  imports: WebAssembly.Module.imports(module), rows, off, heavier, key,
  period: parts.controller.period, unit: parts.loop.parameters[0].unit, time: loop.time,
  status: [controller.step(0.3), controller.fault],
  wrong: [
    said(() => create("wall")), said(() => (loop.parameters.mass = 1)),
    said(() => (loop.parameters[key] = "1")), said(() => (plant.inputs.control = [1])),
    said(() => plant.step(0.1)),
  ],
}));
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wasm")
    loop, context = build_scenario(scenario("two_link_wall", *SETTINGS))
    found = export_wasm(loop, context, "arm", folder, CONFIG)
    assert [path.name for path in found.files[:3]] == ["arm.wasm", "arm.mjs", "arm_exports.c"]
    assert not found.left_out
    return folder, run(loop, context, 0.3, CONFIG)


@needs_zig
@pytest.mark.slow
def test_node_runs_what_drake_does(exported):
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no Node")
    folder, record = exported
    (folder / "script.mjs").write_text(SCRIPT)
    done = subprocess.run(
        [node, "script.mjs"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["imports"] == []
    wanted = np.hstack([record["state"], record["disturbance"]])[:300]
    # The same operations, with the sine of another libm, which a loop that is stable damps.
    np.testing.assert_allclose(found["rows"], wanted, atol=1e-12 * np.abs(wanted).max())
    # Plant and controller, wired by their names, are the loop.
    assert found["off"] <= 1e-13
    assert (found["key"], found["unit"]) == ("two_link_arm.link1.mass", "kg")
    assert abs(found["heavier"]) > 0.1
    assert (found["time"], found["period"]) == (0.0, 0.001)
    assert found["status"] == ["stopped", "number"]
    named = ["'wall'", "mass", "two_link_arm.link1.mass", "control", "t = 0.299 s"]
    assert all(name in said for name, said in zip(named, found["wrong"], strict=True))


@needs_zig
@pytest.mark.slow
def test_the_command_tells_the_size_and_what_is_left_out(tmp_path, capsys):
    words = ["export", "two_link_wall", "--format", "wasm", f"--out={tmp_path}"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "two_link_wall.wasm has " in printed
    assert "not among them: the controller: the controller acts continuously" in printed
    assert (tmp_path / "two_link_wall.wasm").read_bytes()[:4] == b"\0asm"


def test_without_zig_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "find_spec", lambda name: None)
    loop, context = build_scenario(scenario("two_link_wall"))
    with pytest.raises(MachineCodeError, match=r"drake_dae\[compiler\]"):
        export_wasm(loop, context, "arm", tmp_path)
