"""What learning must beat: the nearest recording copied, evidence alone, a Poisson mesh."""
