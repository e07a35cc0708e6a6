"""The acquisition daemon that runs on each Raspberry Pi."""
