"""Ray models of a camera, fitted to dots at two planes or more."""
