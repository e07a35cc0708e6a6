"""Runs on the card: written durably, found again, given to the host."""
