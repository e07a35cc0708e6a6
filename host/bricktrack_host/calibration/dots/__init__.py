"""The dots of a printed target in a picture: found, named, measured."""
