"""Tasks in phases: approach, press, move, release, retreat; what ends each, and the law of each."""
