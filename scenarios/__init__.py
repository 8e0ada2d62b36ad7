"""World, trajectory, instruments and score joined into cases; the catalogue of campaigns as data files."""
