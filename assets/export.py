"""Export: versioned synthetic data sets."""

from assets.factory import assets_of_group

export_assets = assets_of_group("export")
