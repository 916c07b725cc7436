"""Rendering by several machines: a Dask cluster. Imported only where one is asked for."""
