"""How the lasers of the recording sensor differ from each other."""
