"""Hard cases, one file a theme; see docs/numerical_stability.md."""
