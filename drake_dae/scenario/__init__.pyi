"""The names of the room, each with its home."""

from .build import build_commanded as build_commanded
from .build import build_scenario as build_scenario
from .model import complete_scenario as complete_scenario
from .new import new_scenario as new_scenario
from .scenario import Scenario as Scenario
from .scenario import load_scenario as load_scenario
from .scenario import scenario_schema as scenario_schema
from .shipped import shipped_model as shipped_model
