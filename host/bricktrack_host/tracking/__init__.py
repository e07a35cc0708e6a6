"""From pictures to optical poses: lights, identities, PRSOI and its refinement."""
