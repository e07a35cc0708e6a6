"""Pulling runs from the units and turning pixels and inertial samples into poses."""
