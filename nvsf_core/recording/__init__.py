"""A recorded drive in memory, as models use it; files are read elsewhere."""
