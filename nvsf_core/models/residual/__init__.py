"""Our family: small fields and networks that correct what the recording already proves."""
