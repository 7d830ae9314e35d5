"""Batches, the training step and the resumable loop."""
