"""The stages of the processing of one run, each with what it says when something is missing."""
