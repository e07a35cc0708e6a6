"""What can be wrong with a unit, part by part: each finding with a level, words and a remedy."""
