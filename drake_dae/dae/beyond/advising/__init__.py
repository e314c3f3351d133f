"""Gains for a contact and given sensors, as an optimum."""
