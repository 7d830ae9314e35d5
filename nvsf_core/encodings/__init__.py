"""Encodings of positions (hash grids and planes, in space and time) and of directions, as features."""
