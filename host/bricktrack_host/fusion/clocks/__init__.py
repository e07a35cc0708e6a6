"""Which instant a sample and a frame belong to: offset, skew, delays and slips."""
