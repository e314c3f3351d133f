"""Robots in contact as differential-algebraic systems in Drake.

Constrained robots as LeafSystems with the constraint force on an output port, and controllers that
track positions and contact forces at once, after Krishnan and McClamroch, "Tracking in nonlinear
differential-algebraic control systems with applications to constrained robot systems". Equation
numbers in the documentation are those of that paper.
"""

from importlib.metadata import version

import lazy_loader

# The public names stand in __init__.pyi. So the mathematics loads without Drake.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = version("drake_dae")
