"""Reports of DIMES: its paper's figures, the field test, and the landing that uses its answer."""
