"""What can be said of each view without its truth, as rows of the protocol `trust`."""
