"""Parameters and their uncertainty from records."""
