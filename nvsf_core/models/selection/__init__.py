"""What training scans that were left out decide."""
