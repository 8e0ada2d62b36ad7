"""The dashboard: a static site of stored campaigns."""
