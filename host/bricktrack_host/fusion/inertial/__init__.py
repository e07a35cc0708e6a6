"""What the inertial sensor says: samples, their signals and their noise."""
