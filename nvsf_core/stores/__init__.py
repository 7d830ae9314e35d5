"""Everything on disk: published whole, in Zarr, Parquet and safetensors."""
