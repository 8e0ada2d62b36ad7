"""Statistics, verdicts, figures and pages: reads stored results only."""
