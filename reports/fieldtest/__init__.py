"""Reports of the field test of DIMES."""
