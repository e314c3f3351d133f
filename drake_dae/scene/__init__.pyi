"""The names of the room, each with its home."""

from .view import start_meshcat as start_meshcat
