"""Data sets as files that people open: what they hold, and one module a format."""
