"""Block diagrams: the blocks and wires of Drake's own diagram, drawn by Graphviz or as text."""

import re
import shutil
from xml.etree import ElementTree

import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, Gain, Integrator, Multiplexer, VectorLogSink
from runs import scenario

from drake_dae import build_scenario, save_diagram
from drake_dae.cli import main
from drake_dae.errors import ModelError
from drake_dae.pictures.diagram import diagram_text

needs_dot = pytest.mark.skipif(shutil.which("dot") is None, reason="needs Graphviz's dot")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_link_wall", "two_link_measured_force", "wall_point_contact"])
def test_every_block_and_every_wire_but_those_to_logs_is_drawn(name):
    loop, _ = build_scenario(scenario(name))
    text = diagram_text(loop.diagram)
    logs = VectorLogSink, Multiplexer  # All that is logged goes through one Multiplexer.
    blocks = [one for one in loop.diagram.GetSystems() if not isinstance(one, logs)]
    assert len(re.findall(r"^b\d+ \[", text, re.MULTILINE)) == len(blocks)
    names = {one.get_name(): f"b{place}" for place, one in enumerate(blocks)}
    wanted = set()
    for (target, _), (source, leaving) in loop.diagram.connection_map().items():
        if not isinstance(target, logs):
            port = source.get_output_port(leaving).get_name()
            wanted.add((names[source.get_name()], names[target.get_name()], port))
    found = set()
    for begin, end, label in re.findall(r"^(b\d+) -> (b\d+) \[label=<(.*?)>", text, re.MULTILINE):
        found |= {(begin, end, wire.split(" → ")[0]) for wire in label.split("<BR/>")}
    assert found == wanted
    assert len(wanted) > 1


@needs_dot
def test_names_with_markup_stay_text(tmp_path):
    builder = DiagramBuilder()
    gain = builder.AddNamedSystem('</b><i>gain & "more"', Gain(2.0, 1))
    integrator = builder.AddSystem(Integrator(1))
    builder.Connect(gain.get_output_port(), integrator.get_input_port())
    builder.ExportInput(gain.get_input_port(), "<in>")
    builder.ExportOutput(integrator.get_output_port(), "out & out")
    adder = builder.AddSystem(Adder(1, 1))
    builder.Connect(integrator.get_output_port(), adder.get_input_port(0))
    diagram = builder.Build()
    diagram.set_name("a<b")
    save_diagram(diagram, tmp_path / "x.svg")
    texts = [one.text for one in ElementTree.parse(tmp_path / "x.svg").iter() if one.text]
    for words in ('</b><i>gain & "more"', "<in>", "output ports: out & out", "a<b", "Adder"):
        assert words in texts
    assert not any("@" in text for text in texts)  # Drake's name of a block without one.


@needs_dot
def test_command_draws_a_scenario(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["diagram", "two_link_wall"]) == 0
    assert capsys.readouterr().out == "written to two_link_wall.svg\n"
    assert "two_link_arm" in (tmp_path / "two_link_wall.svg").read_text()
    assert main(["diagram", "two_link_wall", "--out", "x.pdf"]) == 0
    assert (tmp_path / "x.pdf").read_bytes().startswith(b"%PDF")


def test_without_dot_a_diagram_is_text_or_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    loop, _ = build_scenario(scenario("two_link_wall"))
    with pytest.raises(ModelError, match="install graphviz"):
        save_diagram(loop.diagram, tmp_path / "x.svg")
    with pytest.raises(ModelError, match=r"is a \.svg, \.png, \.pdf, \.dot, got 'x\.jpg'"):
        save_diagram(loop.diagram, tmp_path / "x.jpg")
    save_diagram(loop.diagram, tmp_path / "x.dot")
    assert "two_link_arm" in (tmp_path / "x.dot").read_text()
    assert loop._repr_html_() is None
