"""The real parts of a unit: camera, bus, pins. Only modules in here import the Raspberry Pi's libraries."""
