"""A loop that runs here and is changed in a browser; and the same run again."""

import http.client
import json
import socket
import threading
from contextlib import closing, contextmanager

import numpy as np
import pytest
from browser import needs_chromium, opened, with_script
from runs import scenario

from drake_dae import Commands, build_commanded, live, replay
from drake_dae.cli import main
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.bench.live import Server
from drake_dae.running.bench.run import HandRun

MOVED = """
  slide("wall.force", 12);
  await run(0.5);
  const found = { force: [now().z[1], now().r[1]], before: now().scene.slice(-6) };
  const wall = bench.view.surfaces[0];
  const toward = bench.view.on_screen(wall.position.clone().add({ x: -0.05, y: 0, z: 0 }));
  point("pointerdown", place(wall));
  point("pointermove", toward);
  await run(1);
  point("pointerup", toward);
  found.after = now().scene.slice(-6);
  found.off = bench.off;
  const { path } = bench.data.bodies[0];
  const link = viewer.scene_tree.find(path).object.getWorldPosition(new MeshCat.THREE.Vector3());
  const at = bench.view.on_screen(viewer.scene.worldToLocal(link));
  point("pointerdown", at);
  point("pointermove", besides(at, 0, -60));
  await run(0.3);
  found.pushed = bench.off;
  point("pointerup", at);
  await run(0.1);
  document.getElementById("bench-save").click();
  await sleep(300);
  found.loaded = performance.getEntriesByType("resource").map(({ name }) => name);
  return found;
"""


@pytest.fixture(scope="module")
def built():
    return build_commanded(scenario("two_link_wall"))


@contextmanager
def serving(built, name="two_link_wall", **more):
    """A server in a thread of its own."""
    config = scenario(name).integrator
    with Server(built.loop, built.context, config, "arm", **more) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.slow
@needs_chromium
def test_what_is_done_in_a_browser_happens_and_is_replayed_exactly(built, tmp_path):
    kept = []

    def save(run):
        run.commands.save(tmp_path / "commands.json")
        kept.append(run.record())
        return "kept"

    with serving(built, save=save) as server:
        server.page = with_script(server.page, MOVED)
        found = opened(server.address, tmp_path / "profile")
    # The predicted error under error control to 1e-8.
    assert found["off"] <= 1e-6
    assert found["force"][0] == pytest.approx(found["force"][1], abs=1e-6)
    assert found["force"][0] > 30.0
    assert found["after"][0] - found["before"][0] == pytest.approx(-0.05, abs=5e-3)
    assert found["after"][3] - found["before"][3] == pytest.approx(-0.05, abs=5e-3)
    assert found["pushed"] > 1e-3
    assert all(name.startswith((server.address, "data:", "blob:")) for name in found["loaded"])
    (record,) = kept
    commands = Commands.load(tmp_path / "commands.json")
    assert len({name for _, name, _ in commands.commands}) > 5
    config = scenario("two_link_wall").integrator
    again = replay(built.loop, built.context, commands, config)
    assert list(again.signals) == list(record.signals)
    np.testing.assert_array_equal(again.time, record.time)
    for name in record.signals:
        np.testing.assert_array_equal(again[name], record[name])


def asked(server, path, method="POST", host=None, body="null"):
    """Status and text of an answer."""
    with closing(http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)) as made:
        headers = {} if host is None else {"Host": host}
        made.request(method, path, body if method == "POST" else None, headers)
        answer = made.getresponse()
        return answer.status, answer.read().decode()


def test_nobody_else_reaches_the_bench(built):
    with serving(built) as server:
        own, _ = server.socket.getsockname()
        assert own == "127.0.0.1"
        assert server.address.startswith(f"http://127.0.0.1:{server.server_port}/")
        assert asked(server, server.path, "GET")[0] == 200
        # Without its secret, as another page of the browser; by a name that points here.
        assert asked(server, "/", "GET")[0] == 404
        assert asked(server, "/start")[0] == 404
        assert asked(server, f"{server.path}start", host="example.org")[0] == 404
        status, text = asked(server, f"{server.path}advance", body='{"ticks": 2, "set": []}')
        assert status == 200
        samples = json.loads(text)["samples"]
        assert [sample["time"] for sample in samples] == pytest.approx([1 / 120, 2 / 120])
    with socket.socket() as gone:
        assert gone.connect_ex(("127.0.0.1", server.server_port)) != 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "body", "said"),
    [
        ("fly", "null", "does not know 'fly'"),
        ("advance", "[]", "a list of changes"),
        ("advance", '{"ticks": 1, "set": [[99999, 1]]}', "no input number 99999"),
        ("advance", '{"ticks": 1, "set": [[0, NaN]]}', "takes nan"),
        ("advance", "{", "Expecting"),
    ],
)
def test_wrong_requests_are_answered_with_a_sentence(built, path, body, said):
    with serving(built) as server:
        status, text = asked(server, server.path + path, body=body)
        assert status == 200
        assert said in json.loads(text)["error"]


def test_a_port_in_use_is_told(built):
    with serving(built) as server, pytest.raises(OSError, match="in use: choose another, or 0"):
        Server(built.loop, built.context, port=server.server_port)
    with pytest.raises(ModelError, match="from 0, for any, to 65535, got 70000"):
        Server(built.loop, built.context, port=70000)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("wall_polish", marks=pytest.mark.thorough),
        "wall_bounce",
        pytest.param("wall_point_contact", marks=pytest.mark.thorough),
    ],
)
def test_what_no_export_knows_runs_too(name):
    own = build_commanded(scenario(name))
    server = Server(own.loop, own.context, scenario(name).integrator)
    with server:
        (start,) = server.answer("start", None)["samples"]
        found = server.answer("advance", {"ticks": 12, "set": []})["samples"]
    assert found[-1]["time"] == pytest.approx(start["time"] + 0.1)
    assert all(value is not None for value in found[-1]["scene"])
    assert found[-1]["z"] != start["z"]
    assert found[-1]["phase"] == ("Move" if name == "wall_polish" else "")


def test_commands_are_checked(tmp_path, built):
    late, early = (2, "x", 1.0), (1, "x", 1.0)
    for wrong in ([late, early], [(11, "x", 1.0)], [(1, "x", np.inf)], [(1, 2, 1.0)], [1]):
        with pytest.raises(ModelError, match="commands"):
            Commands(wrong, 10)
    with pytest.raises(ModelError, match="the tick is a positive time"):
        Commands([], 1, 0.0)
    (tmp_path / "no.json").write_text("[]")
    with pytest.raises(ModelError, match="has no commands of a bench"):
        Commands.load(tmp_path / "no.json")
    with pytest.raises(ModelError, match=r"input of the loop.*'nobody'|'nobody'"):
        replay(built.loop, built.context, Commands([(0, "nobody", 1.0)], 1))


@pytest.mark.slow
def test_the_command_runs_commands_again(tmp_path, built, capsys):
    config = scenario("two_link_wall").integrator
    run = HandRun(built.loop, built.context, config)
    place = run.inputs.names.index("reference.wall.force")
    for k in range(30):
        if k == 10:
            run.set({place: 15.0})
        run.advance()
    run.commands.save(tmp_path / "commands.json")
    words = ["live", "two_link_wall", f"--replay={tmp_path / 'commands.json'}"]
    assert main([*words, f"--out={tmp_path / 'again'}"]) == 0
    assert "0.25 s run again" in capsys.readouterr().out
    with np.load(tmp_path / "again" / "record.npz") as again:
        np.testing.assert_array_equal(again["state"], run.record()["state"])
    assert run.record()["constraint_force"][-1, 0] > 30.0


@pytest.mark.slow
def test_a_loop_that_is_steered_out_of_reach_says_when_and_why():
    own = build_commanded(scenario("planar_3rrr"))
    run = HandRun(own.loop, own.context, scenario("planar_3rrr").integrator)
    run.set({run.inputs.names.index("reference.platform_x"): 5.0})

    def steer():
        for _ in range(400):
            run.advance()

    with pytest.raises(SimulationError, match=r"cannot go on at t = .*a reference is out of reach"):
        steer()


@pytest.mark.thorough
def test_a_signal_that_is_given_by_hand_ends_a_phase():
    own = build_commanded(scenario("wall_guarded"))
    run = HandRun(own.loop, own.context, scenario("wall_guarded").integrator)
    place = run.inputs.names.index("signal_ready")
    phases = []
    for k in range(270):
        if k == 240:
            run.set({place: 1.0})
        run.advance()
        phases.append(own.loop.changes(run.context)[-1].phase)
    assert phases[239] == "Wait"
    assert phases[-1] == "slide"


@needs_chromium
@pytest.mark.thorough
def test_a_contact_that_is_lost_is_searched_again(tmp_path):
    own = build_commanded(scenario("wall_polish"))
    body = """
  await run(5);
  const before = now().phase;
  document.getElementById("bench-lose").click();
  await run(0.4);
  const force = bench.data.bodies.length * 12 + 3;
  return { before, after: now().phase, force: now().scene[force], failure: bench.failure };
"""
    with serving(own, "wall_polish") as server:
        server.page = with_script(server.page, body)
        found = opened(server.address, tmp_path / "profile")
    assert found == {"before": "Move 2", "after": "Approach", "force": 0, "failure": ""}


def test_without_a_browser_the_address_is_told_and_save_writes_files(built, tmp_path, monkeypatch):
    told = []

    def used(server, patience):
        server.answer("advance", {"ticks": 3, "set": []})
        told.append(server.answer("save", None)["saved"])
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", lambda address: False)
    monkeypatch.setattr(Server, "serve_forever", used)
    live(built.loop, built.context, folder=tmp_path / "kept", tell=told.append)
    assert told[0].startswith("http://127.0.0.1:")
    assert told[1:] == [
        "found no browser here; open this address in one on this machine",
        str(tmp_path / "kept"),
    ]
    assert Commands.load(tmp_path / "kept" / "commands.json").end == 3
    assert (tmp_path / "kept" / "record.npz").is_file()
