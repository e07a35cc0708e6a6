"""A day of tests: which units each shake was to be recorded by, and how far it is."""
