"""Recordings as pictures with their time, and recordings made by other means."""
