"""Sampling, execution, storage and replay of campaigns: knows cases and rows, not what they are about."""
