"""The names of the room, each with its home."""

from .study import Study as Study
from .variations import make_variations as make_variations
