"""Motions and forces that determine parameters best."""
