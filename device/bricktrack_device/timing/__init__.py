"""Timing tools: how good a unit's times are, measured on the unit itself, each a command with a report."""
