"""Which pixels and which places along a ray are looked at."""
