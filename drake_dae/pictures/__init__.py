"""Pictures of a recorded run: plots, an animation, a film."""

import lazy_loader

# The names stand in __init__.pyi, and are loaded when they are asked for.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

PLOTS = ("outputs.png", "errors.png", "residual.png", "controls.png", "path.png")
"""The files of `plots.save_plots`; the last one, of points on surfaces, if there are any."""

ANIMATION = "animation.html"
