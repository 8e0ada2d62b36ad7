"""What is being validated: estimators that see measurements only. Of `sim` they import frames, camera and measurements."""
