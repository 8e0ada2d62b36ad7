"""Image operators that more than one algorithm uses: interest, correlation, peaks, alignment."""
