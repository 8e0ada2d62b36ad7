"""Real images with measured attitudes and altitudes, ingested from a user's folder (docs/real-images.md).

`layout` reads the folder, `ingest` converts it to cases, `store` reads and writes cases, and `scenarios` compares
algorithms and images with the measured poses.
"""
