"""Loss terms, one a file, unreduced, and their named weighted sum."""
