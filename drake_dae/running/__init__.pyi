"""The names of the room, each with its home."""

from .export import export_controller as export_controller
from .export import export_loop as export_loop
from .rollout import start_values as start_values
