"""Events of chaos, one file a kind."""
