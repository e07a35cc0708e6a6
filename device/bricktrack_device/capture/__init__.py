"""A run from the first edge to the files: trigger, ring, session, recorder."""
