"""Worker processes, Dask clusters, native child processes, and timing."""
