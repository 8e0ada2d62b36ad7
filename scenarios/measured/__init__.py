"""Real images with measured attitudes and altitudes, ingested from a user's folder (docs/real-images.md).

`layout` reads the parameters and the table of the folder, `folder_reader` its images, `ingest` converts them to a
campaign, and `store` reads and writes cases. `pose_agreement` compares images with their poses. The scenarios are
`velocity`, `landing`, `matching` and `over_map`.
"""
