"""A recorded drive as models read it; no reader."""
