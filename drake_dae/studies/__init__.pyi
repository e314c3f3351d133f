"""The names of the room, each with its home."""

from .study import Study as Study
from .variations import grid_variations as grid_variations
from .variations import listed_variations as listed_variations
from .variations import random_variations as random_variations
