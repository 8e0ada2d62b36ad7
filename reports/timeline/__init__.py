"""Exports and figures of the timeline of a case (`marsyard.scenarios.timeline`)."""
