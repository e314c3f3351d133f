"""The names of the room, each with its home."""

from .closed_loop import ClosedLoop as ClosedLoop
from .closed_loop import make_closed_loop as make_closed_loop
from .closed_loop import wire_loop as wire_loop
from .parts import LoopSettings as LoopSettings
from .record import Record as Record
