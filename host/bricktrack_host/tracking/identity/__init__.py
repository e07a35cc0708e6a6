"""Which light is which LED, in one frame and along a run."""
