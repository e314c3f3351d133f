"""The names of the room, each with its home."""

from .closed_loop import ClosedLoop as ClosedLoop
from .parts import LoopSettings as LoopSettings
from .record import Record as Record
from .wiring import make_closed_loop as make_closed_loop
from .wiring import wire_loop as wire_loop
