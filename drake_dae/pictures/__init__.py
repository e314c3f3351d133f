"""Pictures of a recorded run: plots, an animation, a film."""

PLOTS = ("outputs.png", "errors.png", "residual.png", "controls.png", "path.png")
"""The files of `plots.save_plots`; the last one, of points on surfaces, if there are any."""

ANIMATION = "animation.html"
