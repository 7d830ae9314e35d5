"""Baselines that learning must beat: the nearest recording copied, the evidence alone, a Poisson mesh."""
