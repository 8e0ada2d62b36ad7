"""Statistics of samples and success rates: numbers in, numbers out; nothing here knows rows or requirements."""
