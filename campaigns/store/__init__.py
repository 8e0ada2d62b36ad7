"""Folder of a campaign: record, rows, table, kept products, and lock."""
