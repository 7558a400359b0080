"""Many bags: one row each, on Dask, resumable; a table and a page about the fleet."""
