"""The family `residual` (ours): small fields and networks that correct the evidence."""
