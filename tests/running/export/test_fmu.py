"""Controller and plant as FMUs, run by FMPy, against Drake's Simulator."""

import shutil
import xml.etree.ElementTree as ET
import zipfile

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from runs import run, scenario

from drake_dae import build_scenario, export_fmu
from drake_dae.cli import main
from drake_dae.running.export.fmu.description import exponents

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
STEP = 0.001
CONFIG = SimulatorConfig(
    integration_scheme="runge_kutta3", use_error_control=False, max_step_size=STEP
)
SETTINGS = (
    "sampling={period: 0.001, delay: 0.001}",
    "observer={rate: 20.0}",
    "saturation=true",
    "encoders={resolution: 1.0e-5, velocity_bandwidth: 500}",
    "force_feedback=!MeasuredForce {sample_period: 0.001}",
    "integral=[tool.z, wall.force]",
)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The FMUs of a controller and its plant, and Drake's record of the loop."""
    loop, context = build_scenario(scenario("two_link_wall", *SETTINGS))
    found = export_fmu(loop, context, "arm", tmp_path_factory.mktemp("fmu"), CONFIG)
    assert [path.name for path in found.files] == ["arm_controller.fmu", "arm_plant.fmu"]
    return found, run(loop, context, 0.3, CONFIG)


class Unit:
    """An FMU of FMPy, whose variables have names."""

    def __init__(self, path, folder, **starts: float) -> None:
        fmpy = pytest.importorskip("fmpy", reason="there is no FMPy")
        folder = fmpy.extract(str(path), str(folder))
        about = fmpy.read_model_description(folder)
        self.places = {each.name: each.valueReference for each in about.modelVariables}
        self.about = {each.name: each for each in about.modelVariables}
        self.messages = []
        identifier = about.coSimulation.modelIdentifier
        self.fmu = fmpy.fmi3.FMU3Slave(
            guid=about.guid,
            unzipDirectory=folder,
            modelIdentifier=identifier,
            instanceName=identifier,
        )
        self.fmu.instantiate()
        for name, value in starts.items():
            self[name] = [value]
        self.fmu.enterInitializationMode(startTime=0.0)
        self.fmu.exitInitializationMode()

    def names(self, vector: str) -> list[str]:
        return [name for name in self.places if name.startswith(f"{vector}.")]

    def __getitem__(self, name: str) -> np.ndarray:
        places = [self.places[each] for each in self.names(name) or [name]]
        return np.array(self.fmu.getFloat64(places))

    def __setitem__(self, name: str, values) -> None:
        places = [self.places[each] for each in self.names(name) or [name]]
        self.fmu.setFloat64(places, list(values))

    def step(self, k: int, steps: int = 1) -> None:
        self.fmu.doStep(k * STEP, steps * STEP)

    def status(self) -> tuple[int, int]:
        return tuple(self.fmu.getInt32([self.places["status"], self.places["fault"]]))


@pytest.fixture
def units(exported, tmp_path):
    (controller, plant), _ = exported[0].files, exported[1]
    return Unit(controller, tmp_path / "controller"), Unit(plant, tmp_path / "plant")


def wire(controller: Unit, plant: Unit) -> None:
    for name in ("estimated_state", "measured_force"):
        controller[name] = plant[name]


@pytest.mark.slow
@needs_compiler
def test_both_together_are_the_loop(exported, units):
    """To 1e-12 of the largest: the same operations as in Drake."""
    (controller, plant), record = units, exported[1]
    compared = ["state", "constraint_force", "estimated_state", "measured_force"]
    found = {name: [] for name in [*compared, "control", "reference"]}
    for k in range(300):
        for name in compared:
            found[name].append(plant[name])
        wire(controller, plant)
        controller.step(k)
        assert controller.status() == (0, 0)
        plant["control"] = controller["control"]
        plant.step(k)
        found["control"].append(controller["control"])
        found["reference"].append(controller["reference"])
    for name, rows in found.items():
        # A control acts from its time on: a record, of what was before, has it one row later, and
        # its last row follows the updates of its time.
        wanted, rows = record[name][:299], rows[:299]
        if name == "control":
            wanted, rows = record[name][1:299], rows[:298]
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(rows, wanted, rtol=0, atol=1e-12 * scale, err_msg=name)


@needs_compiler
def test_the_validator_of_fmpy_finds_nothing(exported):
    validation = pytest.importorskip("fmpy.validation", reason="there is no FMPy")
    model = pytest.importorskip("fmpy.model_description", reason="there is no FMPy")
    for path in exported[0].files:
        assert validation.validate_fmu(str(path)) == []
        model.read_model_description(
            str(path), validate_variable_names=True, validate_model_structure=True
        )
        (build,) = model.read_build_description(str(path))
        assert len(build.sourceFileSets[0].sourceFiles) == 2


@needs_compiler
def test_parameters_and_starts_are_set(exported, units, tmp_path):
    _, plant = units
    start = plant["start"]
    np.testing.assert_array_equal(plant["state"], start)
    assert plant.about["two_link_arm.link1.mass"].start == "12.0"
    path = exported[0].files[1]
    heavier = Unit(path, tmp_path / "heavier", **{"two_link_arm.link1.mass": 24.0})
    assert heavier["constraint_force"] != plant["constraint_force"]
    heavier.step(0)
    plant.step(0)
    assert np.abs(heavier["state"] - plant["state"]).max() > 1e-6
    # What is fixed is not set any more, and what is computed never.
    for name in ("start", "state"):
        with pytest.raises(Exception, match=r"fmi3SetFloat64|status"):
            plant[name] = start


@needs_compiler
def test_a_state_is_kept_and_comes_back(units):
    controller, plant = units
    wire(controller, plant)
    kept = controller.fmu.getFMUState()
    bytes_ = controller.fmu.serializeFMUState(kept)
    controller.step(0, 5)
    there = controller["control"]
    controller.fmu.setFMUState(kept)
    controller.step(0, 5)
    np.testing.assert_array_equal(controller["control"], there)
    controller.fmu.freeFMUState(kept)
    again = controller.fmu.deserializeFMUState(bytes_)
    controller.fmu.setFMUState(again)
    controller.step(0, 5)
    np.testing.assert_array_equal(controller["control"], there)
    controller.fmu.reset()
    controller.fmu.enterInitializationMode(startTime=0.0)
    controller.fmu.exitInitializationMode()
    np.testing.assert_array_equal(controller["control"], [0.0, 0.0])


@needs_compiler
def test_what_is_wrong_is_held_and_stops(units):
    controller, plant = units
    wire(controller, plant)
    controller.step(0)
    controller["measurement_age"] = [1.0]
    controller.step(1)
    assert controller.status() == (1, 2)
    controller.step(2, 20)
    assert controller.status() == (2, 2)
    plant["control"] = [np.nan, 0.0]
    with pytest.raises(Exception, match=r"fmi3DoStep|status"):
        plant.step(0)
    with pytest.raises(Exception, match=r"fmi3DoStep|status"):
        controller.step(500)


@needs_compiler
def test_what_stands_in_an_fmu(exported):
    for path in exported[0].files:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            root = ET.fromstring(archive.read("modelDescription.xml"))
        stem = path.stem
        assert {"sources/buildDescription.xml", f"sources/{stem}.c", f"sources/{stem}.h"} < set(
            names
        )
        assert any(name.startswith("binaries/") for name in names)
        variables = list(root.find("ModelVariables"))
        units = {each.get("name") for each in root.find("UnitDefinitions")}
        assert {each.get("unit") for each in variables if each.get("unit")} <= units
        assert {"N m", "rad", "rad/s"} <= units
        parameters = [each for each in variables if each.get("causality") == "parameter"]
        assert parameters
        assert all(np.isfinite(float(each.get("start"))) for each in parameters)


def test_without_a_compiler_there_are_sources(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CC", "no-such-compiler")
    assert main(["export", "two_link_wall", "--format=fmu", f"--out={tmp_path}"]) == 0
    said = capsys.readouterr().out
    assert "two_link_wall_plant.fmu" in said
    assert "a binary of the plant, of which there are sources: no C compiler: CC names" in said
    assert "the controller: the controller acts continuously" in said
    with zipfile.ZipFile(tmp_path / "two_link_wall_plant.fmu") as archive:
        assert not any(name.startswith("binaries/") for name in archive.namelist())


@pytest.mark.parametrize(
    ("unit", "wanted"),
    [
        ("N m/s^2", {"kg": 1, "m": 2, "s": -4}),
        ("m/(N s)", {"kg": -1, "s": 1}),
        ("1/s", {"s": -1}),
        ("kg m^2", {"kg": 1, "m": 2}),
        ("rad/s", {"rad": 1, "s": -1}),
        ("ohm", {"kg": 1, "m": 2, "s": -3, "A": -2}),
        ("parsec", None),
        ("m^x", None),
    ],
)
def test_units_are_those_of_si(unit, wanted):
    assert exponents(unit) == wanted
