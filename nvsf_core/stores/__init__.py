"""Read and write outputs on disk, published whole: Zarr, Parquet, safetensors, JSON."""
