"""The printed target of dots: its geometry, its drawing, what it can calibrate."""
