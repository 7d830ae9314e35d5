"""Which views a scene is asked for, and how each is rendered and written."""
