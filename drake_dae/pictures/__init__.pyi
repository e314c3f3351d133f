"""The names of the room, each with its home."""

from .animation import make_animation as make_animation
from .film import save_film as save_film
from .page import write_page as write_page
from .plots import plot_runs as plot_runs

PLOTS: tuple[str, ...]
ANIMATION: str
