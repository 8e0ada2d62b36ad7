"""Statistics of samples and success rates, without knowledge of rows or requirements."""
