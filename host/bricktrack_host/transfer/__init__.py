"""Talking to the units and bringing their runs over, verified."""
