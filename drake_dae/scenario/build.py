"""A scenario, completed and built."""

from dataclasses import dataclass

from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.dae.structure.structure import Structure
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import AssumptionError, ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice.advice import advised
from drake_dae.scenario.advice.sticking import sticking_before
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.controllers.task_controller import check_task
from drake_dae.scenario.forms.keys import violated
from drake_dae.scenario.loop import build_loop
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario


@checked(lambda text: ScenarioError(("", text)))
def build_scenario(
    scenario: Scenario, meshcat: Meshcat | None = None
) -> tuple[ClosedLoop, Context]:
    """Builds the closed loop of a scenario, and its context at the start.

    Args:
        scenario: A scenario, as `load_scenario` returns it.
        meshcat: The Meshcat for a live view; None for no view.

    Raises:
        ScenarioError: The scenario is not valid; the message names the key.
    """
    completed, loop = build_completed(scenario, meshcat)
    return loop, start_scenario(completed.scenario, loop)


def build_completed(
    scenario: Scenario, meshcat: Meshcat | None = None, commanded: bool = False
) -> tuple[Completed, ClosedLoop]:
    """Completes a scenario and builds its loop, which `start_scenario` can start repeatedly.

    Arguments and errors are as for `build_scenario` and `build_loop`.
    """
    scene_graph = SceneGraph()
    prepared = _prepared(scenario, scene_graph)
    scenario, model, structure = prepared.completed.scenario, prepared.model, prepared.structure
    loop = build_loop(
        scenario,
        model,
        structure,
        scene_graph,
        meshcat,
        commanded=commanded,
    )
    told = filter(None, [sticking_before(scenario, model, structure)])
    return Completed(scenario, (*prepared.completed.notes, *told)), loop


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A completed scenario, and what `build_loop` needs besides."""

    completed: Completed
    model: RobotModel
    structure: Structure


def _prepared(scenario: Scenario, scene_graph: SceneGraph) -> _Prepared:
    if scenario.task is not None:
        check_task(scenario)
    completed, model = completed_model(scenario, scene_graph)
    try:
        structure = scenario_structure(model)
    except AssumptionError as error:
        raise violated(error) from error
    chosen = advised(completed.scenario, model, structure)
    notes = (*completed.notes, *chosen.notes)
    return _Prepared(Completed(chosen.scenario, notes), model, structure)
