"""Which rays a view asks for, and what comes back."""
