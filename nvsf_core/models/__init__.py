"""The method: how each family of recipes is trained and rendered, and the baselines."""
