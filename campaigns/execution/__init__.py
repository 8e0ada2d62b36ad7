"""Execution of cases in monitored worker processes, on this machine or on a cluster."""
