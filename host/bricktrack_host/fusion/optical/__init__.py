"""Motion from the optical poses alone, and what stands beside a pose."""
