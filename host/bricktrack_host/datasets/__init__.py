"""Results of many tests together: the dataset of a campaign, and what changed between two processings."""
