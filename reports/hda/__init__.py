"""What reports and replays show of the hazard detection and avoidance of `papers/vision-guided-landing.txt`."""
