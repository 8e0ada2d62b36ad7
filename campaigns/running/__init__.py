"""Run, resume, extend and estimate campaigns; run single cases again."""
