"""Real images with measured attitudes and altitudes, ingested from a user's folder (docs/real-images.md).

`layout` reads the folder, `ingest` converts it to cases, and `store` reads and writes cases. The scenarios
are `velocity`, `landing`, `matching` and `over_map`.
"""
