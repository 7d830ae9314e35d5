"""How a stage is run: skipped or made, recorded, resumed, one training per device."""
