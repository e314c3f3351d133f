"""The names of the room, each with its home."""

from .block import Block as Block
from .block import Held as Held
from .block import Requirement as Requirement
from .compose import compile_diagram as compile_diagram
from .symbolic import from_symbolic as from_symbolic
from .traced_system import TracedSystem as TracedSystem
