"""Fusion in which each frame counts as one pose."""
