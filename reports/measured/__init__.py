"""Real cases: how their images and measured poses agree."""
