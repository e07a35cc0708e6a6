"""Processed runs to look at: the video with everything found drawn on it."""
