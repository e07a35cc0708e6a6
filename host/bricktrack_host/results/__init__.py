"""What users take away: tables, rest pose, the laboratory's samples, errors against truth."""
