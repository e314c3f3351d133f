"""References: desired values over time with all derivatives that a law needs."""

import lazy_loader

# The names stand in __init__.pyi, and are loaded when they are asked for.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
