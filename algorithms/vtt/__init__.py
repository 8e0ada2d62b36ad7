"""Visual target tracking: the rover drives to what it sees (Kim et al., "Targeted Driving Using Visual Tracking")."""
