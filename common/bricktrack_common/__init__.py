"""What the brick units and the host agree on: frames, clocks, files and messages."""
