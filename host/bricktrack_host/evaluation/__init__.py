"""The source paper's evaluation: known positions, what was measured of them, and the bound on it."""
