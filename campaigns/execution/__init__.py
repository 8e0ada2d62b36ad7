"""Who runs cases, and how one runs: worker processes that are watched, here or on a cluster."""
