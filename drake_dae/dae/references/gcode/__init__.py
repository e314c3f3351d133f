"""References from programs of machine tools, in G-code."""
