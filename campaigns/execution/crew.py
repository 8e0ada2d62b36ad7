"""Former name of the executor configuration."""

from marsyard.campaigns.execution.workers import ExecutorConfig as Crew

__all__ = ["Crew"]
