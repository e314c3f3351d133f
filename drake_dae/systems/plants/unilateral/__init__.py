"""Robots with opening and closing contacts: modes, guards, resets, and the plant."""
