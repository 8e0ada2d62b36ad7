"""What is being validated: estimators that see measurements only (of `sim`: frames, camera, measurements)."""
