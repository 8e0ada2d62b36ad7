"""Reports of hazard detection and avoidance (`papers/vision-guided-landing.txt`)."""
