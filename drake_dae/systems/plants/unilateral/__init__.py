"""Robots whose contacts open and close: modes, guards, resets, and the plant that runs them."""
