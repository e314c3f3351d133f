"""The names of the room, each with its home."""

from .bench.page import write_page as write_page
from .export.export import export_code as export_code
from .export.steps.controller import export_controller as export_controller
from .export.wasm.wasm import export_wasm as export_wasm
from .record_writer import RecordWriter as RecordWriter
from .rollout.problems import start_values as start_values
