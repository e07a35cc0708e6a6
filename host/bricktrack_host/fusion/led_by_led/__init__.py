"""Fusion in which each LED counts by itself, at the time of its row."""
