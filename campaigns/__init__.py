"""Sampling, execution, storage and replay of campaigns; independent of the content of cases and rows."""
