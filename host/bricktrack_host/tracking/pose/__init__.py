"""The pose of a frame from lights whose LEDs are known: PRSOI and the refinement on pixels."""
