"""The offline page that shows a view's scans in three dimensions, beside the recorded ones."""
