"""Custom Python algorithms in processes of their own, which receive measurements only and never hold the truth."""
