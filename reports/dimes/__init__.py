"""What reports say of DIMES alone: its paper's figures, the field test, and the landing that its answer is for."""
