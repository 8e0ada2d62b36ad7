"""A campaign's folder: its record, rows and table, what is kept of cases, and the lock on it."""
