"""Components of a cracked brick against each other: many units' results on the laboratory's samples."""
