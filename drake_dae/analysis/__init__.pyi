"""The names of the room, each with its home."""

from .report import Analysis as Analysis
