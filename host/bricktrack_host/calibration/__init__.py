"""From pictures of dot targets to rays, with their uncertainty."""
