"""Folder of a campaign: record, rows, table, stored products, and lock."""
