"""The dashboard: a static site over stored campaigns."""
