"""Plan, render and write the views of a scene."""
